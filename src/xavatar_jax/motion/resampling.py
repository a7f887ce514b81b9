"""Changing the frame rate of a motion."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from .record import Motion


def resample(motion: Motion, fps: float) -> Motion:
    """The motion at another frame rate, from the first frame to the last it reaches.

    Rotations follow the shortest arc between neighbouring frames (slerp), the rest is linear.

    Args:
        motion: the motion.
        fps: frames a second afterwards.

    Raises:
        ValueError: `fps` is not positive.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"Cannot resample to {fps} frames a second; it must be positive.")
    if fps == motion.fps:
        return motion
    count = int(np.floor(motion.seconds * fps + 1e-6)) + 1
    position = np.minimum(np.arange(count) / fps * motion.fps, len(motion) - 1)
    before = np.minimum(position.astype(np.int64), max(len(motion) - 2, 0))
    after = np.minimum(before + 1, len(motion) - 1)
    weight = position - before

    def linear(values: np.ndarray) -> np.ndarray:
        w = weight.reshape(-1, *([1] * (values.ndim - 1)))
        return (1 - w) * values[before] + w * values[after]

    return replace(
        motion,
        poses=_slerp(motion.poses[before], motion.poses[after], weight),
        transl=linear(motion.transl),
        expression=linear(motion.expression),  # type: ignore[arg-type]
        fps=float(fps),
    )


def _slerp(
    first: Float[np.ndarray, "T J 3"],
    second: Float[np.ndarray, "T J 3"],
    weight: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T J 3"]:
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(first.reshape(-1, 3))
    step = (start.inv() * Rotation.from_rotvec(second.reshape(-1, 3))).as_rotvec()
    part = Rotation.from_rotvec(step * np.repeat(weight, first.shape[1])[:, None])
    return (start * part).as_rotvec().reshape(first.shape)
