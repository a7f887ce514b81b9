"""Two-bone inverse kinematics for arms and legs, batched over frames."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Vectors = Float[np.ndarray, "*batch 3"]
Rotations = Float[np.ndarray, "*batch 3 3"]


class TwoBone(NamedTuple):
    """Rotation of the upper bone in the frame of the target, and of the lower bone relative to
    the upper."""

    upper: Rotations
    lower: Rotations


def unit(v: np.ndarray) -> np.ndarray:
    """Vectors scaled to length one along the last axis."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def rotation_about(axis: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Rotation matrices by `angle` (radians, batched) about one or more unit axes."""
    return to_matrix(unit(np.asarray(axis, np.float64)) * np.asarray(angle)[..., None])


def to_matrix(rotvec: np.ndarray) -> np.ndarray:
    """Axis-angle vectors (..., 3) to matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = np.asarray(rotvec, np.float64).reshape(-1, 3)
    return Rotation.from_rotvec(flat).as_matrix().reshape(*np.shape(rotvec), 3)


def to_rotvec(matrix: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) to axis-angle vectors (..., 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])


def align(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The smallest rotations from unit vectors `first` to `second`, which must not be opposite."""
    first, second = np.broadcast_arrays(first, second)
    axis = np.cross(first, second)
    sine = np.linalg.norm(axis, axis=-1)
    cosine = (first * second).sum(-1)
    return rotation_about(axis, np.arctan2(sine, cosine))


def frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rotation matrices with columns `first`, `second` made perpendicular, and their product."""
    x = unit(first)
    y = unit(second - (second * x).sum(-1, keepdims=True) * x)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def two_bone(
    root: Vectors,
    target: Vectors,
    pole: Vectors,
    upper_rest: Float[np.ndarray, 3],
    lower_rest: Float[np.ndarray, 3],
    hinge_rest: Float[np.ndarray, 3],
    *,
    reach: float = 0.997,
) -> TwoBone:
    """Bend a limb so that its end reaches a target, or points at it if it is out of reach.

    Args:
        root: position of the limb's first joint (shoulder, hip).
        target: position of the end (wrist, ankle).
        pole: direction of the middle joint (elbow, knee).
        upper_rest, lower_rest: the two bones at rest, as vectors.
        hinge_rest: the axis, at rest, about which the middle joint bends.
        reach: maximum distance, as a fraction of the limb's length.
    """
    a, b = np.linalg.norm(upper_rest), np.linalg.norm(lower_rest)
    offset = target - root
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    distance = np.clip(distance, abs(a - b) + 0.05 * (a + b), reach * (a + b))
    along = unit(offset)
    side = unit(pole - (pole * along).sum(-1, keepdims=True) * along)
    cosine = (a**2 + distance**2 - b**2) / (2 * a * distance)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
    upper = cosine * along + sine * side
    lower = unit(distance * along - a * upper)
    hinge = -np.cross(along, side)
    at_rest = frame(unit(upper_rest), np.asarray(hinge_rest, np.float64))
    upper_rotation = frame(upper, hinge) @ at_rest.T
    local = np.einsum("...ji,...j->...i", upper_rotation, lower)
    return TwoBone(upper_rotation, align(unit(lower_rest), local))
