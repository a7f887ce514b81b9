"""Geometry fields at points that stay where they are, while the condition changes."""

from __future__ import annotations

import abc
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .softplus import softplus

_BATCH = 4096
_EXACT = jax.lax.Precision.HIGHEST


class Carrying(Protocol):
    """What is asked of a geometry field here."""

    def __call__(self, x_c: Float[Array, "3"], condition: Any) -> Float[Array, ""]: ...
    def carry(self, x_c: Float[Array, "3"], condition: Any) -> Float[Array, "3"]: ...


class AbstractFixedPoints(eqx.Module):
    """A geometry field at N places of the neutral person, for one frame's condition after another.

    A condition may carry them (`AbstractGeometryField.carry`), and they are asked where they are.
    """

    @abc.abstractmethod
    def __call__(self, condition: Any) -> Float[Array, " N"]:
        """Logits under one condition, as the field itself gives them where the points are then."""

    @abc.abstractmethod
    def carried(self, condition: Any) -> Float[Array, "N 3"]:
        """Where the points are under one condition, metres."""


class FixedPoints(AbstractFixedPoints):
    """Any field: evaluated anew for each condition, some thousand points at a time."""

    field: Carrying
    points: Float[Array, "N 3"]

    def __call__(self, condition: Any) -> Float[Array, " N"]:
        count = len(self.points)
        padded = jnp.pad(self.carried(condition), ((0, -count % _BATCH), (0, 0)))
        each = jax.vmap(lambda x: self.field(x, condition))
        return jax.lax.map(each, padded.reshape(-1, _BATCH, 3)).reshape(-1)[:count]

    def carried(self, condition: Any) -> Float[Array, "N 3"]:
        return jax.vmap(lambda x: self.field.carry(x, condition))(self.points)


class FixedHash(AbstractFixedPoints):
    """A hash field: of its grids only what the first layer makes of them is kept.

    For each condition there remain a product with the points' nearness to the joints and the
    small network.
    """

    first: Float[Array, "N width"]
    nearness: Float[Array, "N J"]
    expressive: Float[Array, "N E K2"] | None
    points: Float[Array, "N 3"]
    moves: Float[Array, "N E 3"] | None
    from_condition: Float[Array, "width K1"]
    hidden: tuple[Float[Array, "out in"], ...]
    biases: tuple[Float[Array, " out"], ...]
    sharpness: float = eqx.field(static=True)

    def __call__(self, condition: Any) -> Float[Array, " N"]:
        joints, expression = condition.joints, condition.expression
        weight, width = self.from_condition, joints.shape[-1]
        h = self.first + _matmul(self.nearness, _matmul(joints, weight[:, :width].T))
        if self.expressive is not None:
            expressed = jnp.einsum("nek,e->nk", self.expressive, expression, precision=_EXACT)
            h = h + _matmul(expressed, weight[:, width:].T)
        for weight, bias in zip(self.hidden, self.biases, strict=True):
            h = _matmul(softplus(h, self.sharpness), weight.T) + bias
        return h[:, 0]

    def carried(self, condition: Any) -> Float[Array, "N 3"]:
        if self.moves is None:
            return self.points
        moved = jnp.einsum("nek,e->nk", self.moves, condition.moves, precision=_EXACT)
        return self.points + moved


def _matmul(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=_EXACT)
