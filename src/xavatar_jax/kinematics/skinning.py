"""Forward kinematics and linear blend skinning."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .inverse import solve_3x3
from .tree import KinematicTree

# No reduced-precision products on accelerators.
_PRECISION = jax.lax.Precision.HIGHEST


def forward_kinematics(
    tree: KinematicTree, rotations: Float[Array, "J 3 3"], joints: Float[Array, "J 3"]
) -> Float[Array, "J 4 4"]:
    """World transform of each joint, computed one tree level at a time.

    `rotations` are relative to the parent; `joints` are rest positions in metres. At rest the
    frame of every joint is aligned with the world.
    """
    rotations, joints = jnp.asarray(rotations), jnp.asarray(joints)
    bottom = jnp.zeros((tree.num_joints, 1, 4), rotations.dtype).at[:, 0, 3].set(1)
    parents = np.maximum(np.asarray(tree.parents), 0)
    offsets = (joints - joints[parents]).at[0].set(joints[0])
    local = jnp.concatenate([jnp.concatenate([rotations, offsets[..., None]], -1), bottom], -2)
    levels = tree.levels
    done = [local[np.asarray(levels[0])]]
    position = {joint: k for k, joint in enumerate(levels[0])}
    for level in levels[1:]:
        above = done[-1][np.asarray([position[tree.parents[joint]] for joint in level])]
        done.append(jnp.matmul(above, local[np.asarray(level)], precision=_PRECISION))
        position = {joint: k for k, joint in enumerate(level)}
    order = np.argsort(np.concatenate([np.asarray(level) for level in levels]))
    return jnp.concatenate(done)[order]


def relative_transforms(
    tree: KinematicTree, rotations: Float[Array, "J 3 3"], joints: Float[Array, "J 3"]
) -> Float[Array, "J 4 4"]:
    """Transforms from the rest pose to the posed one: A of SMPL (Loper et al., 2015)."""
    world = forward_kinematics(tree, rotations, joints)
    moved = jnp.einsum("jab,jb->ja", world[:, :3, :3], joints, precision=_PRECISION)
    return world.at[:, :3, 3].add(-moved)


def blend_transforms(
    weights: Float[Array, "*points J"], transforms: Float[Array, "J 4 4"]
) -> Float[Array, "*points 3 4"]:
    """Weighted sums of bone transforms, as one matrix product."""
    flat = transforms[:, :3, :].reshape(transforms.shape[0], 12)
    rows = jnp.matmul(weights, flat, precision=_PRECISION)
    return rows.reshape(*weights.shape[:-1], 3, 4)


def transform_point(
    transform: Float[Array, "*points 3 4"], x: Float[Array, "*points 3"]
) -> Float[Array, "*points 3"]:
    """Apply one affine transform to each point."""
    linear = (transform[..., :3] * x[..., None, :]).sum(-1)
    return linear + transform[..., 3]


def skin_points(
    x_c: Float[Array, "*points 3"],
    weights: Float[Array, "*points J"],
    transforms: Float[Array, "J 4 4"],
) -> Float[Array, "*points 3"]:
    """Carry canonical points to the posed frame: $d(x_c) = \\sum_i w_i B_i x_c$ (X-Avatar, eq. 1).

    `weights` sum to one over the J bones; `transforms` of one frame map canonical to posed metres.
    """
    return transform_point(blend_transforms(weights, transforms), x_c)


def unskin_points(
    x_d: Float[Array, "*points 3"],
    weights: Float[Array, "*points J"],
    transforms: Float[Array, "J 4 4"],
) -> Float[Array, "*points 3"]:
    """Invert `skin_points` for known weights: $x = (\\sum_i w_i B_i)^{-1} x_d$."""
    blended = blend_transforms(weights, transforms)
    return solve_3x3(blended[..., :3], x_d - blended[..., 3])
