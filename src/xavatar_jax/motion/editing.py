"""Joining motions, filling missing frames, and motions in camera axes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..body import BodyModel
from .record import Motion, MotionNotice, pelvis_of
from .rotations import interpolate


def concat(motions: Sequence[Motion], *, blend: float = 0.0, follow: bool = False) -> Motion:
    """Join motions one after another, each faded into the next.

    During a blend both motions run at once: rotations are interpolated along the shortest arc,
    translation and expression linearly, with a weight that starts and ends at rest. Without a
    blend the second motion begins one frame after the first has ended.

    Args:
        motions: with the same joints, frame rate and up axis.
        blend: seconds that neighbours share.
        follow: move each motion over the ground so that it starts where the previous one ends.
            Height and direction are kept.

    Raises:
        ValueError: no motions, motions that do not match, or one shorter than the blend.
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
            f"{other.source} has {other.fps:g} frames per second and {first.source} "
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

    mixed = interpolate(first.poses[kept:], second.poses[:shared], weight) if shared else None
    parts = [first.poses[:kept], *([] if mixed is None else [mixed]), second.poses[shared:]]
    notices = tuple(dict.fromkeys((*first.notices, *second.notices)))
    one, other = (np.trim_zeros(m.betas, "b") for m in (first, second))
    if not np.array_equal(one, other):
        notice = f"{second.source}: its shape differs from that of {first.source}, which is used."
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


def fill_gaps(motion: Motion, numbers: Sequence[int]) -> Motion:
    """Place frames by their numbers and interpolate missing ones, with a notice.

    Numbers that rise by a constant step are taken as consecutive.

    Args:
        motion: the frames that were found.
        numbers: the number of each frame, rising.

    Raises:
        ValueError: the numbers do not rise, or more than nine tenths of the frames are missing.
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
            f"consecutive at {motion.fps:g} frames per second."
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
    position = np.interp(np.arange(count), places, np.arange(len(found)))
    return motion.sampled(position, motion.fps).with_notice(
        f"{motion.source}: {missing} of {count} frames are missing, up to {longest} in a row; "
        "they are interpolated."
    )


def _listed(numbers: np.ndarray) -> str:
    shown = ", ".join(map(str, numbers[:6]))
    return f"{shown}, ..., {numbers[-1]}" if len(numbers) > 6 else shown


def from_camera(motion: Motion, body: BodyModel | None) -> Motion:
    """Turn a motion from OpenCV camera axes (x right, y down, z forward) to a y-up world.

    Without a body the world turns about a pelvis at the origin, which moves the whole motion by a
    constant; a notice says so. A motion without translation keeps none.

    Args:
        motion: in camera axes.
        body: gives the pelvis to turn about.
    """
    turn = np.diag([1.0, -1.0, -1.0])
    if not motion.transl.any():
        return replace(motion.rotate(turn, np.zeros(3), up="y"), transl=motion.transl)
    if body is not None:
        return motion.rotate(turn, pelvis_of(motion, body), up="y")
    return motion.rotate(turn, np.zeros(3), up="y").with_notice(
        f"{motion.source}: turned y-up without a body, so the whole motion is displaced by a "
        "constant of a few decimetres; pass body= for the exact position."
    )
