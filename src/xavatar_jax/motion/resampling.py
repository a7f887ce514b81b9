"""Motions between their frames: another frame rate, missing frames."""

from __future__ import annotations

from collections.abc import Sequence
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
    return _sample(motion, np.arange(count) / fps * motion.fps, fps)


def fill_gaps(motion: Motion, numbers: Sequence[int]) -> Motion:
    """Put frames where their numbers say and fill what is missing between, with a notice.

    Numbers that rise by a constant step are taken as consecutive.

    Args:
        motion: its frames follow one another.
        numbers: the number of each frame, rising.

    Raises:
        ValueError: numbers that do not rise, or as many missing frames as could be no motion.
    """
    found = np.asarray(numbers, np.int64)
    steps = np.diff(found)
    if steps.size and steps.min() < 1:
        raise ValueError(f"{motion.source}: frame numbers {_listed(found)} do not rise.")
    if not steps.size or steps.max() == 1:
        return motion
    step = int(np.gcd.reduce(steps))
    places = (found - found[0]) // step
    if step > 1:
        motion = motion.with_notice(
            f"{motion.source}: frames are numbered in steps of {step}; they are taken as "
            f"consecutive at {motion.fps:g} frames a second."
        )
    count = int(places[-1]) + 1
    missing = count - len(found)
    if not missing:
        return motion
    if missing > 9 * len(found):
        raise ValueError(
            f"{motion.source}: {len(found)} frames are numbered {_listed(found)}, so {missing} "
            "are missing between them; keep the files of one clip."
        )
    longest = int(np.diff(places).max()) - 1
    filled = _sample(motion, np.interp(np.arange(count), places, np.arange(len(found))), motion.fps)
    return filled.with_notice(
        f"{motion.source}: {missing} of {count} frames are missing, up to {longest} in a row; "
        "they are interpolated."
    )


def _listed(numbers: np.ndarray) -> str:
    shown = ", ".join(map(str, numbers[:6]))
    return f"{shown}, ..., {numbers[-1]}" if len(numbers) > 6 else shown


def _sample(motion: Motion, position: Float[np.ndarray, " N"], fps: float) -> Motion:
    """The motion at places counted in its frames; beyond the last frame, the last frame."""
    position = np.minimum(position, len(motion) - 1)
    before = np.minimum(position.astype(np.int64), max(len(motion) - 2, 0))
    after = np.minimum(before + 1, len(motion) - 1)
    weight = position - before

    def linear(values: np.ndarray) -> np.ndarray:
        w = weight.reshape(-1, *([1] * (values.ndim - 1)))
        return (1 - w) * values[before] + w * values[after]

    return replace(
        motion,
        poses=slerp(motion.poses[before], motion.poses[after], weight),
        transl=linear(motion.transl),
        expression=linear(motion.expression),  # type: ignore[arg-type]
        fps=float(fps),
    )


def slerp(
    first: Float[np.ndarray, "T J 3"],
    second: Float[np.ndarray, "T J 3"],
    weight: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T J 3"]:
    """Rotations between two, along the shortest arc; `weight` 0 is the first, 1 the second."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(first.reshape(-1, 3))
    step = (start.inv() * Rotation.from_rotvec(second.reshape(-1, 3))).as_rotvec()
    part = Rotation.from_rotvec(step * np.repeat(weight, first.shape[1])[:, None])
    return (start * part).as_rotvec().reshape(first.shape)
