"""From what the sliders say to parameters of the body, and where a person looks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..avatar import Avatar
from ..body import BodyParams
from ..body.joints import pose_groups
from ..kinematics import KinematicTree

UpAxis = Literal["y", "z"]
UP: dict[str, tuple[float, float, float]] = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def rest_params(avatar: Avatar) -> BodyParams:
    """One frame: the avatar's shape in the body's rest pose, batched `(1, ...)`."""
    return BodyParams.create(
        avatar.body, transl=np.zeros((1, 3)), betas=np.asarray(avatar.betas)[None]
    )


def turned(
    params: BodyParams,
    turns: Mapping[int, ArrayLike],
    expression: Float[np.ndarray, " E"] | None = None,
) -> BodyParams:
    """Parameters of one frame with joints turned further and expression added.

    Args:
        params: of one frame, `(J, 3)`.
        turns: by joint, the axis-angle of a rotation that acts before the frame's own, radians.
        expression: added to the first coefficients.
    """
    from scipy.spatial.transform import Rotation

    pose = np.array(params.pose, np.float64)
    for joint, turn in turns.items():
        own = Rotation.from_rotvec(pose[joint]) * Rotation.from_rotvec(np.asarray(turn, float))
        pose[joint] = own.as_rotvec()
    coefficients = np.array(params.expression, np.float64)
    if expression is not None:
        count = min(len(expression), len(coefficients))
        coefficients[:count] += np.asarray(expression)[:count]
    dtype = params.pose.dtype
    return replace(
        params, pose=jnp.asarray(pose, dtype), expression=jnp.asarray(coefficients, dtype)
    )


def joint_choices(tree: KinematicTree) -> dict[str, dict[str, tuple[int, ...]]]:
    """By group of sliders, the joints that can be chosen: single ones, and all fingers at once.

    Groups without joints are left out; jaw and eyes are one group, the head.
    """
    groups = pose_groups(tree)
    names = tree.names

    def single(joints: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
        return {names[j].replace("_", " "): (j,) for j in joints}

    out = {"Body": single((*groups["global_orient"], *groups["body_pose"]))}
    for side in ("left", "right"):
        joints = groups[f"{side}_hand_pose"]
        fingers = tuple(j for j in joints if "thumb" not in names[j])
        together = {"all fingers": fingers} if fingers else {}
        out[f"{side.capitalize()} hand"] = {**together, **single(joints)}
    eyes = (*groups["leye_pose"], *groups["reye_pose"])
    both = {"both eyes": eyes} if len(eyes) > 1 else {}
    out["Jaw and eyes"] = {**single(groups["jaw_pose"]), **both}
    return {name: choices for name, choices in out.items() if choices}


def frame_of(params: BodyParams, index: int) -> BodyParams:
    """One frame of batched parameters, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], params)
