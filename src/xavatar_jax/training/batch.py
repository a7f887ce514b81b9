"""What one step of training looks at."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int

from ..body import BodyParams


class Batch(NamedTuple):
    """Points of B frames, M each; the first Q of a frame may have further roots.

    `rooted`: whether a point has a stored root. Those without are drawn from frames alone in which
    no root was found, and count for nothing.
    """

    points: Float[Array, "B M 3"]
    parts: Int[Array, "B M"]
    distance: Float[Array, "B M"]
    root: Float[Array, "B M 3"]
    rooted: Bool[Array, "B M"]
    others: Float[Array, "B Q K 3"]
    others_valid: Bool[Array, "B Q K"]
    transforms: Float[Array, "B J 4 4"]
    params: BodyParams
