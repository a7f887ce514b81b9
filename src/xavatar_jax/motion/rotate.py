"""Turning the world of a motion, and its up axis."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..body import rest_joints
from ..kinematics import TO_Y_UP
from .convert import shape_for

if TYPE_CHECKING:
    from ..body import BodyModel
    from .record import Motion, UpAxis

# Rotations that carry one up axis to the other, about x, so that x stays.
_TO_UP = {"y": TO_Y_UP["z"], "z": TO_Y_UP["z"].T}


def rest_pelvis(body: BodyModel, betas: Float[np.ndarray, " S"]) -> Float[np.ndarray, 3]:
    """Position of the root joint at rest, for one shape: the point a body is turned about.

    Args:
        body: the body model.
        betas: shape coefficients, cut to the body's number.
    """
    fitted = jnp.asarray(betas[: body.num_betas], float)
    return np.asarray(rest_joints(body, fitted)[0], np.float64)


def pelvis_of(motion: Motion, body: BodyModel) -> Float[np.ndarray, 3]:
    """`rest_pelvis` of the body in the motion's shape, the mean one if that is of another model."""
    return rest_pelvis(body, shape_for(motion, body)[0])


def rotate_world(
    motion: Motion,
    rotation: Float[np.ndarray, "3 3"],
    pelvis: Float[np.ndarray, 3],
    *,
    up: UpAxis | None = None,
) -> Motion:
    r"""Turn the world of a motion about its origin.

    A body turns about its rest pelvis $p$, not about the origin: posed vertices are
    $R_g (v - p) + p + t$. Turning the world by $R$ therefore changes both the orientation,
    $R_g' = R R_g$, and the translation, $t' = R (t + p) - p$.

    Args:
        motion: the motion.
        rotation: $R$, a rotation matrix.
        pelvis: $p$, as `rest_pelvis` gives it for the motion's betas.
        up: the axis that points up afterwards; None keeps what the motion says.

    Raises:
        ValueError: `rotation` is not a rotation.
    """
    from scipy.spatial.transform import Rotation

    rotation, pelvis = np.asarray(rotation, np.float64), np.asarray(pelvis, np.float64)
    error = np.abs(rotation @ rotation.T - np.eye(3)).max() if rotation.shape == (3, 3) else np.inf
    if not error < 1e-5 or np.linalg.det(rotation) < 0:
        raise ValueError(f"Not a rotation matrix (shape {rotation.shape}, error {error:.2g}).")
    poses = motion.poses.copy()
    root = Rotation.from_matrix(rotation) * Rotation.from_rotvec(poses[:, 0])
    poses[:, 0] = root.as_rotvec()
    transl = (motion.transl + pelvis) @ rotation.T - pelvis
    return replace(motion, poses=poses, transl=transl, up=up or motion.up)


def to_up(motion: Motion, body: BodyModel, up: UpAxis) -> Motion:
    """The motion in a world whose `up` axis points up; x stays where it is.

    Args:
        motion: the motion; its betas give the pelvis to turn about.
        body: the body that the motion is for.
        up: "y" or "z".
    """
    if motion.up == up:
        return motion
    return rotate_world(motion, _TO_UP[up], pelvis_of(motion, body), up=up)


def from_camera(motion: Motion, body: BodyModel | None) -> Motion:
    """The motion in a y-up world, of one in OpenCV camera axes (x right, y down, z forward).

    Where no body is given the world turns about a pelvis at the origin, which moves the whole
    motion by a constant; the notice says so. A motion without translation keeps none.

    Args:
        motion: in camera axes.
        body: gives the pelvis to turn about.
    """
    turn = np.diag([1.0, -1.0, -1.0])
    if not motion.transl.any():
        return replace(rotate_world(motion, turn, np.zeros(3), up="y"), transl=motion.transl)
    if body is not None:
        return rotate_world(motion, turn, pelvis_of(motion, body), up="y")
    return rotate_world(motion, turn, np.zeros(3), up="y").with_notice(
        f"{motion.source}: turned y-up without a body, so the place of the whole motion is off by "
        "a constant of a few decimetres; pass body= for the exact one."
    )
