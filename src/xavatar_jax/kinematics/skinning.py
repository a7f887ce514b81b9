"""Linear blend skinning of one point; `jax.vmap` for many."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .inverse import solve_3x3


def blend_transforms(
    weights: Float[Array, "*points J"], transforms: Float[Array, "J 4 4"]
) -> Float[Array, "*points 3 4"]:
    """Weighted sums of bone transforms, as one matrix product for any number of points."""
    flat = transforms[:, :3, :].reshape(transforms.shape[0], 12)
    rows = jnp.matmul(weights, flat, precision=jax.lax.Precision.HIGHEST)
    return rows.reshape(*weights.shape[:-1], 3, 4)


def transform_point(
    transform: Float[Array, "*points 3 4"], x: Float[Array, "*points 3"]
) -> Float[Array, "*points 3"]:
    """Apply affine transforms to as many points."""
    linear = (transform[..., :3] * x[..., None, :]).sum(-1)
    return linear + transform[..., 3]


def skin_points(
    x_c: Float[Array, "*points 3"],
    weights: Float[Array, "*points J"],
    transforms: Float[Array, "J 4 4"],
) -> Float[Array, "*points 3"]:
    """Carry canonical points to the posed frame: $d(x_c) = \\sum_i w_i B_i x_c$ (X-Avatar, eq. 1).

    `weights` sum to one over the J bones; `transforms` map canonical to posed metres. Points may
    have any leading axes, none included; the transforms are those of one frame.
    """
    return transform_point(blend_transforms(weights, transforms), x_c)


def unskin_points(
    x_d: Float[Array, "*points 3"],
    weights: Float[Array, "*points J"],
    transforms: Float[Array, "J 4 4"],
) -> Float[Array, "*points 3"]:
    """Undo `skin_points` where the weights are known: $x = (\\sum_i w_i B_i)^{-1} x_d$."""
    blended = blend_transforms(weights, transforms)
    return solve_3x3(blended[..., :3], x_d - blended[..., 3])
