"""Points on the canonical skeleton, for the regularisers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..kinematics import KinematicTree

POINTS_PER_BONE = 5


def bone_points(
    tree: KinematicTree, joints: Float[Array, "J 3"], key: PRNGKeyArray
) -> Float[Array, "n 3"]:
    """Five jittered points along each bone from parent to joint (X-Avatar's released code)."""
    parents = np.asarray(tree.parents[1:])
    share = jnp.linspace(0.0, 1.0, POINTS_PER_BONE)[None, :]
    share = share + 0.1 * jax.random.normal(key, (len(parents), POINTS_PER_BONE))
    share = jnp.clip(share, 0, 1)[..., None].astype(joints.dtype)
    start, end = joints[parents][:, None], joints[1:][:, None]
    return (start + share * (end - start)).reshape(-1, 3)


def joint_targets(tree: KinematicTree) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the joint-weight term: joints to look at, and a one-hot bone for each.

    Each joint with its own bone, and each but the root with its parent's, which together pull the
    two bones that meet to one half each (X-Avatar's released code).
    """
    count = tree.num_joints
    where = np.concatenate([np.arange(count), np.arange(1, count)])
    bone = np.concatenate([np.arange(count), np.asarray(tree.parents[1:])])
    return where, np.eye(count, dtype=np.float32)[bone]
