"""Small inverses in closed form: an order of magnitude faster than batched LAPACK calls."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def inverse_3x3(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Inverse by cofactors. A singular matrix gives infinities or NaN: mask by the determinant."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    bc, ca, ab = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    determinant = jnp.sum(a * bc, axis=-1)
    return jnp.stack([bc, ca, ab], axis=-1) / determinant[..., None, None]


def inverse_rigid(transform: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """Inverse of rotations with a translation and, possibly, one scale."""
    linear, shift = transform[..., :3, :3], transform[..., :3, 3]
    scale_sq = jnp.sum(linear[..., 0, :] ** 2, axis=-1)[..., None, None]
    inverse = jnp.swapaxes(linear, -1, -2) / scale_sq
    moved = -(inverse * shift[..., None, :]).sum(-1, keepdims=True)
    upper = jnp.concatenate([inverse, moved], axis=-1)
    return jnp.concatenate([upper, transform[..., 3:, :]], axis=-2)
