"""Forward kinematics, one tree level at a time: as many steps as the tree is deep."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .tree import KinematicTree

# Geometry needs every bit of float32: no reduced-precision products on accelerators.
_PRECISION = jax.lax.Precision.HIGHEST


def forward_kinematics(
    tree: KinematicTree, rotations: Float[Array, "J 3 3"], joints: Float[Array, "J 3"]
) -> Float[Array, "J 4 4"]:
    """World transform of each joint's frame.

    `rotations` are relative to the parent; `joints` are rest positions in metres, where every
    joint's frame is aligned with the world.
    """
    rotations, joints = jnp.asarray(rotations), jnp.asarray(joints)
    bottom = jnp.zeros((tree.num_joints, 1, 4), rotations.dtype).at[:, 0, 3].set(1)
    parents = np.maximum(np.asarray(tree.parents), 0)
    offsets = (joints - joints[parents]).at[0].set(joints[0])
    local = jnp.concatenate([jnp.concatenate([rotations, offsets[..., None]], -1), bottom], -2)
    levels = tree.levels
    done = [local[np.asarray(levels[0])]]
    place = {joint: k for k, joint in enumerate(levels[0])}
    for level in levels[1:]:
        above = done[-1][np.asarray([place[tree.parents[joint]] for joint in level])]
        done.append(jnp.matmul(above, local[np.asarray(level)], precision=_PRECISION))
        place = {joint: k for k, joint in enumerate(level)}
    order = np.argsort(np.concatenate([np.asarray(level) for level in levels]))
    return jnp.concatenate(done)[order]


def relative_transforms(
    tree: KinematicTree, rotations: Float[Array, "J 3 3"], joints: Float[Array, "J 3"]
) -> Float[Array, "J 4 4"]:
    """Transforms from the rest pose to the posed one: `forward_kinematics` less the rest joints.

    The identity rotations give identity transforms. This is the A of SMPL (Loper et al., 2015).
    """
    world = forward_kinematics(tree, rotations, joints)
    moved = jnp.einsum("jab,jb->ja", world[:, :3, :3], joints, precision=_PRECISION)
    return world.at[:, :3, 3].add(-moved)
