"""Colour fields."""

from __future__ import annotations

import abc

import equinox as eqx
from jaxtyping import Array, Float


class AbstractColorField(eqx.Module):
    """Maps a canonical point to a colour."""

    @abc.abstractmethod
    def __call__(
        self,
        x_c: Float[Array, "3"],
        feature: Float[Array, " f"] | None = None,
        normal: Float[Array, "3"] | None = None,
    ) -> Float[Array, "3"]:
        """RGB in [0, 1] at `x_c` (metres, canonical space).

        `feature` is that of the geometry field at the point, `normal` its unit normal; a field may
        ignore either.
        """
