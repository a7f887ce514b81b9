"""Rotations over time as arrays: interpolation, averaging, turning the root."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_STEPS = 3  # of the mean of rotations; each shrinks the rest by about the window's angle squared


def interpolate(
    first: Float[np.ndarray, "T J 3"],
    second: Float[np.ndarray, "T J 3"],
    weight: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T J 3"]:
    """Rotations between two along the shortest arc (slerp); weight 0 is the first, 1 the second."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(first.reshape(-1, 3))
    step = (start.inv() * Rotation.from_rotvec(second.reshape(-1, 3))).as_rotvec()
    part = Rotation.from_rotvec(step * np.repeat(weight, first.shape[1])[:, None])
    return (start * part).as_rotvec().reshape(first.shape)


def turn_first(
    poses: Float[np.ndarray, "T J 3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "T J 3"]:
    """Poses whose first joint is turned by a rotation of the world."""
    from scipy.spatial.transform import Rotation

    poses = poses.copy()
    poses[:, 0] = (Rotation.from_matrix(rotation) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses


def smoothing_window(count: int, deviation: float) -> Float[np.ndarray, "W T"]:
    """Gaussian weights of both neighbours at distance 0, 1, ... of each frame, which sum to 1.

    Args:
        count: number of frames. The window is cut to the frames that exist on both sides.
        deviation: standard deviation in frames.
    """
    if deviation == 0:
        return np.ones((1, count))
    reach = min(int(np.ceil(3 * deviation)), (count - 1) // 2)
    distance = np.arange(reach + 1)[:, None]
    room = np.minimum(np.arange(count), np.arange(count)[::-1])
    weights = np.exp(-0.5 * (distance / deviation) ** 2) * (distance <= room)
    return weights / (weights[0] + 2 * weights[1:].sum(axis=0))


def mean_over_time(
    values: Float[np.ndarray, "T *n"], weights: Float[np.ndarray, "W T"], *, rotations: bool = False
) -> Float[np.ndarray, "T *n"]:
    r"""Mean of every frame's neighbours, with weights of `smoothing_window`.

    Args:
        values: numbers, or rotation vectors `(T, J, 3)`.
        weights: of the neighbours.
        rotations: average as rotations: the mean is the one from which the neighbours' rotation
            vectors sum to zero, $\sum_k w_k \log(\bar R^{-1} R_k) = 0$ (Karcher's mean). It does
            not depend on the axes, and does not jump where a rotation passes half a turn.
    """
    if rotations:
        return _mean_rotations(values, weights)
    total = weights[0][:, None] * values
    for distance in range(1, len(weights)):
        before, after = _neighbours(values, distance)
        total = total + weights[distance][:, None] * (before + after)
    return total


def _neighbours(values: np.ndarray, distance: int) -> tuple[np.ndarray, np.ndarray]:
    index = np.arange(len(values))
    return values[np.maximum(index - distance, 0)], values[
        np.minimum(index + distance, len(values) - 1)
    ]


def _mean_rotations(
    poses: Float[np.ndarray, "T J 3"], weights: np.ndarray
) -> Float[np.ndarray, "T J 3"]:
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_rotvec(poses.reshape(-1, 3))
    quaternions = flat.as_quat().reshape(*poses.shape[:2], 4)
    mean = quaternions
    for _ in range(_STEPS):
        step = weights[0][:, None, None] * _relative(mean, quaternions)
        for distance in range(1, len(weights)):
            before, after = _neighbours(quaternions, distance)
            both = _relative(mean, before) + _relative(mean, after)
            step += weights[distance][:, None, None] * both
        moved = Rotation.from_quat(mean.reshape(-1, 4)) * Rotation.from_rotvec(step.reshape(-1, 3))
        mean = moved.as_quat().reshape(mean.shape)
    return moved.as_rotvec().reshape(poses.shape)


def _relative(
    base: Float[np.ndarray, "T J 4"], other: Float[np.ndarray, "T J 4"]
) -> Float[np.ndarray, "T J 3"]:
    """Rotation vectors from one rotation to another, both quaternions (x, y, z, w).

    Written on whole arrays: SciPy's rotations take a microsecond each, and there are millions.
    """
    u, v = base[..., :3], other[..., :3]
    w = base[..., 3] * other[..., 3] + np.sum(u * v, axis=-1)
    xyz = base[..., 3:] * v - other[..., 3:] * u - np.cross(u, v)
    xyz, w = np.where(w[..., None] < 0, -xyz, xyz), np.abs(w)
    sine = np.linalg.norm(xyz, axis=-1)
    # The factor tends to 2 for no rotation, which the other branch gives for w = 1.
    factor = np.where(sine > 1e-12, 2 * np.arctan2(sine, w) / np.maximum(sine, 1e-12), 2.0)
    return factor[..., None] * xyz
