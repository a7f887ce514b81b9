"""Smoothing a motion: a local mean of rotations as rotations, not of their components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from .record import Motion

_STEPS = 3  # of the mean of rotations; each shrinks the rest by about the window's angle squared


def smooth(motion: Motion, seconds: float, joints: Sequence[str] | None = None) -> Motion:
    r"""The motion with jitter faster than about `seconds` removed.

    Every frame becomes the mean of its neighbours under a Gaussian window of standard deviation
    `seconds`. The mean of rotations is the one from which the neighbours' rotation vectors add up
    to zero, $\sum_k w_k \log(\bar R^{-1} R_k) = 0$ (Karcher's mean), so it neither depends on the
    axes nor jumps where a rotation passes half a turn. Towards the ends the window narrows, so
    that the first and the last frame stay, and steady motion stays steady.

    Args:
        motion: the motion.
        seconds: standard deviation of the window.
        joints: smooth only these joints, and leave translation and expression as they are; None
            smooths everything.

    Raises:
        ValueError: `seconds` is negative, or a joint is not in the motion.
    """
    if not (np.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"Cannot smooth over {seconds} seconds; it must be zero or more.")
    unknown = [name for name in joints or () if name not in motion.joint_names]
    if unknown:
        raise ValueError(f"{motion.source}: no joint {', '.join(unknown)} to smooth.")
    weights = _window(len(motion), seconds * motion.fps)
    if len(weights) == 1:
        return motion
    poses = motion.poses.copy()
    chosen = [j for j, name in enumerate(motion.joint_names) if joints is None or name in joints]
    poses[:, chosen] = _mean_rotations(motion.poses[:, chosen], weights)
    if joints is not None:
        return replace(motion, poses=poses)
    expression = np.asarray(motion.expression)
    return replace(
        motion,
        poses=poses,
        transl=_mean(motion.transl, weights),
        expression=_mean(expression, weights),
    )


def _window(count: int, deviation: float) -> Float[np.ndarray, "W T"]:
    """Weight of both neighbours at distance 0, 1, ... of each frame; a frame's weights sum to 1."""
    if deviation == 0:
        return np.ones((1, count))
    reach = min(int(np.ceil(3 * deviation)), (count - 1) // 2)
    distance = np.arange(reach + 1)[:, None]
    room = np.minimum(np.arange(count), np.arange(count)[::-1])
    weights = np.exp(-0.5 * (distance / deviation) ** 2) * (distance <= room)
    return weights / (weights[0] + 2 * weights[1:].sum(axis=0))


def _neighbours(values: np.ndarray, distance: int) -> tuple[np.ndarray, np.ndarray]:
    index = np.arange(len(values))
    return values[np.maximum(index - distance, 0)], values[
        np.minimum(index + distance, len(values) - 1)
    ]


def _mean(values: Float[np.ndarray, "T n"], weights: np.ndarray) -> Float[np.ndarray, "T n"]:
    total = weights[0][:, None] * values
    for distance in range(1, len(weights)):
        before, after = _neighbours(values, distance)
        total = total + weights[distance][:, None] * (before + after)
    return total


def _mean_rotations(
    poses: Float[np.ndarray, "T J 3"], weights: np.ndarray
) -> Float[np.ndarray, "T J 3"]:
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_rotvec(poses.reshape(-1, 3))
    quaternions = flat.as_quat().reshape(*poses.shape[:2], 4)
    mean = quaternions
    for _ in range(_STEPS):
        step = weights[0][:, None, None] * _seen_from(mean, quaternions)
        for distance in range(1, len(weights)):
            before, after = _neighbours(quaternions, distance)
            both = _seen_from(mean, before) + _seen_from(mean, after)
            step += weights[distance][:, None, None] * both
        moved = Rotation.from_quat(mean.reshape(-1, 4)) * Rotation.from_rotvec(step.reshape(-1, 3))
        mean = moved.as_quat().reshape(mean.shape)
    return moved.as_rotvec().reshape(poses.shape)


def _seen_from(
    base: Float[np.ndarray, "T J 4"], other: Float[np.ndarray, "T J 4"]
) -> Float[np.ndarray, "T J 3"]:
    """Rotation vectors from one rotation to another, of quaternions x, y, z, w.

    Arrays at once: SciPy's rotations take a microsecond each, and there are millions here.
    """
    u, v = base[..., :3], other[..., :3]
    w = base[..., 3] * other[..., 3] + np.sum(u * v, axis=-1)
    xyz = base[..., 3:] * v - other[..., 3:] * u - np.cross(u, v)
    xyz, w = np.where(w[..., None] < 0, -xyz, xyz), np.abs(w)
    sine = np.linalg.norm(xyz, axis=-1)
    # At no rotation the factor tends to 2, which w = 1 gives by the other branch.
    factor = np.where(sine > 1e-12, 2 * np.arctan2(sine, w) / np.maximum(sine, 1e-12), 2.0)
    return factor[..., None] * xyz
