"""What any avatar offers, whatever method made it."""

from __future__ import annotations

import abc
from typing import Literal, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt8

from ..body import BodyModel, BodyParams
from ..meshing import Mesh

Mode = Literal["fast", "full"]


class AbstractRestSurface(eqx.Module):
    """A surface in canonical space that is posed by linear blend skinning.

    - `faces`: the same in every frame.
    - `vertices`: the neutral person's, one per column, metres.
    - `weights`: skinning weights of the vertices over the joints of the avatar's body.
    - `colors`: sRGB of the vertices, or None.
    - `num_expression`: how many coefficients of expression move the surface.
    """

    faces: eqx.AbstractVar[Int[np.ndarray, "F 3"]]
    vertices: eqx.AbstractVar[Float[Array, "3 V"]]
    weights: eqx.AbstractVar[Float[Array, "J V"]]
    colors: eqx.AbstractVar[UInt8[np.ndarray, "V C"] | None]
    num_expression: eqx.AbstractVar[int]

    @abc.abstractmethod
    def condition(self, params: BodyParams) -> PyTree[Array]:
        """What `under` needs to know about one frame, as arrays. May be vmapped over frames."""

    @abc.abstractmethod
    def under(self, condition: PyTree[Array]) -> Float[Array, "3 V"]:
        """Canonical vertices of the frame with this condition, before skinning, metres."""


@runtime_checkable
class Drivable(Protocol):
    """A person who can be posed with the parameters of a body model.

    Posing, animation, export, rendering, viewing and evaluation need nothing else.
    """

    @property
    def body(self) -> BodyModel:
        """The body that parameters are for."""
        ...

    @property
    def betas(self) -> Float[np.ndarray, " S"]:
        """The person's shape. It replaces the shape in parameters."""
        ...

    @property
    def rest(self) -> AbstractRestSurface:
        """The surface at rest, made on first access."""
        ...

    def surface(self, params: BodyParams, *, mode: Mode = "fast") -> Mesh:
        """The posed surface of one frame, metres, with vertex colours if the method has colour.

        `fast` skins the rest surface; `full` is the method's most accurate surface.
        """
        ...

    def posed_template(self, params: BodyParams) -> Float[np.ndarray, "V 3"]:
        """Vertices of the body model itself in this pose and the person's shape, metres."""
        ...
