"""Hand poses as files store them, to absolute ones and back."""

from __future__ import annotations

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .joints import pose_groups
from .model import BodyModel

Side = Literal["left", "right"]


def hands_to_absolute(body: BodyModel, hand_pose: Any, side: Side) -> Float[Array, "*batch n 3"]:
    """Mean-relative hand pose (`flat_hand_mean=False`) to the absolute one used here.

    `hand_pose` is `(..., 45)` or `(..., 15, 3)`, or fewer PCA coefficients `(..., 6 | 12 | 24)`,
    which are expanded with the model's own components.

    **Raises:** `ValueError` if the body has no such hand, or no components for PCA coefficients.
    """
    joints = _hand_joints(body, side)
    pose = jnp.asarray(hand_pose, body.template.dtype)
    if pose.shape[-2:] != (len(joints), 3):
        if pose.shape[-1] != 3 * len(joints):
            pose = _expand(body, pose, side)
        pose = pose.reshape(*pose.shape[:-1], len(joints), 3)
    return pose + body.hand_mean[joints]


def hands_to_relative(
    body: BodyModel, hand_pose: Float[Array, "*batch n 3"], side: Side
) -> Float[Array, "*batch n 3"]:
    """Absolute hand pose to the mean-relative one that many files hold."""
    return hand_pose - body.hand_mean[_hand_joints(body, side)]


def _hand_joints(body: BodyModel, side: Side) -> np.ndarray:
    joints = pose_groups(body.tree)[f"{side}_hand_pose"]
    if not joints:
        raise ValueError(f"the body ({body.source.describe()}) has no {side} hand joints")
    return np.asarray(joints)


def _expand(body: BodyModel, coefficients: Array, side: Side) -> Array:
    components = body.hand_components.get(side)
    count = coefficients.shape[-1]
    if components is None or count > len(components):
        have = "none" if components is None else str(len(components))
        raise ValueError(
            f"{side}_hand_pose has {count} numbers, which is neither a full pose nor PCA "
            f"coefficients of this body ({have} components)"
        )
    return coefficients @ jnp.asarray(components[:count], coefficients.dtype)
