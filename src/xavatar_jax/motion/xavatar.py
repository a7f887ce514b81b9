"""Reading and writing the pose vector of the reference implementation of X-Avatar.

One vector a frame: scale, translation (3), orientation (3), body (63), left and right hand (h
numbers each, relative to the mean hand: 45, or principal components), left eye, right eye, jaw (3
each, in this order), ten shape and ten expression coefficients; 99 + 2 h in all. The reference
puts zero for the eyes.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ..body import BodyModel
from ..files import atomic_path
from .format import Format, ReadOptions, Source
from .params import read_frames, to_motion
from .record import Motion, MotionNotice, fit_size, shape_for
from .values import grouped_poses

_FIXED = 99
_COEFFICIENTS = 10
_KEY = "smpl_params"  # the reference's name for the vector
_WIDTHS = {_FIXED + 2 * count for count in (6, 12, 24, 45)}


def _vectors(source: Source) -> np.ndarray | None:
    data = source.data.get(_KEY) if source.keys else source.data
    if not isinstance(data, np.ndarray):
        return None
    return data if data.ndim in (1, 2) and data.shape[-1] in _WIDTHS else None


def _read(source: Source, options: ReadOptions) -> Motion:
    vectors = np.atleast_2d(np.asarray(_vectors(source), np.float64))
    hand = (vectors.shape[1] - _FIXED) // 2
    data, start = {}, 0
    for name, width in (*_LAYOUT[:4], ("left_hand_pose", hand), ("right_hand_pose", hand), *_TAIL):
        data[name] = vectors[:, start : start + width]
        start += width
    scale = data.pop("scale")
    if not np.abs(scale - 1).max() < 1e-5:
        raise ValueError(
            f"{source.path}: scale {scale.min():g} to {scale.max():g}; a motion has none. Bring "
            "the person to scale 1 before."
        )
    notices: list[str] = []
    frames = read_frames(data, source.path, options, notices)
    return to_motion(frames, source.path, options, notices, up=options.up or "y")


def save_xavatar(path: str | Path, motion: Motion, body: BodyModel) -> Path:
    """Write a motion as pose vectors `(T, 189)` of X-Avatar's reference code, a `.npy` array.

    Frame rate and gender are not in the format, and shape and expression have ten coefficients.
    What the motion has beyond that is named in a `MotionNotice`.

    Args:
        path: the `.npy` to write; replaced as a whole, or not at all.
        motion: a y-up motion.
        body: gives the mean hand that hand poses are relative to.

    Raises:
        ValueError: the motion is not y-up.
    """
    if motion.up != "y":
        raise ValueError(
            f"{motion.source}: pose vectors are y-up and this motion is {motion.up}-up; save "
            "motion.to_y_up(body)."
        )
    poses, notices = grouped_poses(motion, body)
    parts = {"scale": np.ones((len(motion), 1)), "transl": motion.transl, **poses}
    shape, notice = shape_for(motion, body)
    notices += [] if notice is None else [notice]
    betas = np.broadcast_to(shape, (len(motion), len(shape)))
    for name, values in (("betas", betas), ("expression", np.asarray(motion.expression))):
        parts[name], notice = fit_size(values, _COEFFICIENTS, name, motion.source, "the format")
        notices += [] if notice is None else [notice]
    notices.append(f"{motion.source}: pose vectors hold neither frame rate nor gender.")
    for notice in notices:
        warnings.warn(notice, MotionNotice, stacklevel=2)
    order = [name for name, _ in (*_LAYOUT, *_TAIL)]
    vectors = np.concatenate([parts[name] for name in order], axis=1)
    target = Path(path)
    with atomic_path(target) as temporary, open(temporary, "wb") as file:
        np.save(file, vectors, allow_pickle=False)
    return target


_LAYOUT = (
    ("scale", 1), ("transl", 3), ("global_orient", 3), ("body_pose", 63),
    ("left_hand_pose", 45), ("right_hand_pose", 45),
)  # fmt: skip
_TAIL = (
    ("leye_pose", 3), ("reye_pose", 3), ("jaw_pose", 3),
    ("betas", _COEFFICIENTS), ("expression", _COEFFICIENTS),
)  # fmt: skip

FORMAT = Format(
    name="xavatar",
    title="X-Avatar's pose vectors",
    sought="an array (T, 99 + 2 h) with h hand numbers of 6, 12, 24 or 45, as .npy or as the "
    "entry smpl_params",
    recognise=lambda source: _vectors(source) is not None,
    read=_read,
)
