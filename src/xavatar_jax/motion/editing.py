"""Cutting motions and joining them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .convert import MotionNotice
from .resampling import slerp

if TYPE_CHECKING:
    from .record import Motion


def trim(motion: Motion, start: float = 0.0, end: float | None = None) -> Motion:
    """The frames from `start` to `end`, both included, in seconds from the first frame.

    Args:
        motion: the motion.
        start, end: seconds; None is the end of the motion.

    Raises:
        ValueError: no frame lies between them.
    """
    last = motion.seconds if end is None else end
    # A frame that rounding puts just outside counts as inside.
    places = np.arange(len(motion))
    inside = (places >= start * motion.fps - 1e-6) & (places <= last * motion.fps + 1e-6)
    if not inside.any():
        raise ValueError(
            f"{motion.source}: no frame between {start:g} and {last:g} seconds; the motion runs "
            f"from 0 to {motion.seconds:g}."
        )
    kept = np.flatnonzero(inside)
    return motion[int(kept[0]) : int(kept[-1]) + 1]


def concat(motions: Sequence[Motion], *, blend: float = 0.0, follow: bool = False) -> Motion:
    """Motions one after another, each faded into the next.

    For `blend` seconds two motions run at once: rotations go from the one to the other along the
    shortest arc, translation and expression in a straight line, all with a weight that starts and
    ends at rest. Without a blend the second begins a frame after the first has ended.

    Args:
        motions: with the same joints, frame rate and up axis.
        blend: seconds that neighbours share.
        follow: move each motion over the ground so that it starts where the one before it is,
            instead of sliding there. Height and direction are kept.

    Raises:
        ValueError: nothing to join, motions that do not match, or shorter than the blend.
    """
    if not motions:
        raise ValueError("No motions to join.")
    if not (np.isfinite(blend) and blend >= 0):
        raise ValueError(f"Cannot blend over {blend} seconds; it must be zero or more.")
    first = motions[0]
    for other in motions[1:]:
        _check_match(first, other)
    shared = round(blend * first.fps)
    if len(motions) > 1 and shared > min(map(len, motions)):
        short = min(motions, key=len)
        raise ValueError(
            f"{short.source}: {len(short)} frames are fewer than the {shared} of the blend."
        )
    joined = first
    for other in motions[1:]:
        joined = _join(joined, other, shared, follow)
    return joined


def _check_match(first: Motion, other: Motion) -> None:
    if other.joint_names != first.joint_names:
        raise ValueError(f"{other.source} has other joints than {first.source}.")
    if other.fps != first.fps:
        raise ValueError(
            f"{other.source} runs at {other.fps:g} frames a second and {first.source} at "
            f"{first.fps:g}; resample one."
        )
    if other.up != first.up:
        raise ValueError(
            f"{other.source} is {other.up}-up and {first.source} {first.up}-up; turn one with "
            "to_y_up or to_z_up."
        )


def _join(first: Motion, second: Motion, shared: int, follow: bool) -> Motion:
    size = max(np.asarray(m.expression).shape[1] for m in (first, second))

    def expression(motion: Motion) -> np.ndarray:
        values = np.asarray(motion.expression)
        return np.pad(values, ((0, 0), (0, size - values.shape[1])))

    transl = second.transl
    if follow:
        start = first.transl[len(first) - max(shared, 1)] - transl[0]
        transl = transl + np.where(np.array([True, first.up == "z", first.up == "y"]), start, 0)
    kept = len(first) - shared
    ramp = (np.arange(shared) + 1) / (shared + 1)
    weight = ramp * ramp * (3 - 2 * ramp)

    def linear(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        mixed = (1 - weight[:, None]) * a[kept:] + weight[:, None] * b[:shared]
        return np.concatenate([a[:kept], mixed, b[shared:]])

    mixed = slerp(first.poses[kept:], second.poses[:shared], weight) if shared else None
    parts = [first.poses[:kept], *([] if mixed is None else [mixed]), second.poses[shared:]]
    notices = tuple(dict.fromkeys((*first.notices, *second.notices)))
    mine, other = (np.trim_zeros(m.betas, "b") for m in (first, second))
    if not np.array_equal(mine, other):
        notice = f"{second.source}: another shape than {first.source}; the first one's is used."
        warnings.warn(notice, MotionNotice, stacklevel=4)
        notices += (notice,)
    return replace(
        first,
        poses=np.concatenate(parts),
        transl=linear(first.transl, transl),
        expression=linear(expression(first), expression(second)),
        source=f"{first.source} + {second.source}",
        notices=notices,
    )
