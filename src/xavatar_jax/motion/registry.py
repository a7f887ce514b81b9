"""All motion formats: finding out which one a file is, and the one way in and out."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from ..body import BodyModel
from . import (
    amass,
    bvh,
    easymocap,
    grab,
    params,
    phalp,
    pose_pickle,
    pymafx,
    smplerx,
    xavatar,
    xhumans,
)
from .content import explain
from .format import Format, ReadOptions, Source, open_source
from .record import Motion, MotionNotice, UpAxis

_T = TypeVar("_T")
FORMATS: dict[str, Format] = {
    module.FORMAT.name: module.FORMAT
    for module in (
        *(amass, grab, xhumans, xavatar, pymafx, smplerx, phalp, easymocap, bvh, params),
    )
}
"""Motion formats that are read, by name, in the order in which they are tried."""
WRITERS = ("amass", "bvh", "poses", "xavatar")
_SUFFIXES = {".npz": "amass", ".bvh": "bvh", ".pkl": "poses", "": "poses", ".npy": "xavatar"}


def load_motion(
    path: str | Path,
    *,
    body: BodyModel | None = None,
    format: str | None = None,
    fps: float | None = None,
    up: UpAxis | None = None,
    person: int | None = None,
    flat_hand_mean: bool | None = None,
    joint_map: str | Path | Mapping[str, str] | None = None,
    scale: float | None = None,
) -> Motion:
    """Read a motion from a file or folder, whose format is recognised by what is in it.

    What is assumed, filled in or left out is in `Motion.notices` and warned about
    (`MotionNotice`).

    Args:
        path: file or folder.
        body: the body that is to move. Needed where a file's numbers mean nothing without one:
            hands relative to the mean hand or as principal components, EasyMocap, BVH.
        format: a key of `FORMATS`, for a file that could be several.
        fps: frames per second, in the place of what the file says.
        up: the axis that points up in the file's world; None takes the format's own.
        person: which person, of a file with several.
        flat_hand_mean: True if the file's hands are absolute, False if they are relative to the
            mean hand; None takes what the file says, else the format's own.
        joint_map: for BVH, a key of `JOINT_MAPS`, a mapping from names of the file to names of
            SMPL-X, or the path of a JSON file with one.
        scale: for BVH, metres in one unit of the file.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        ValueError: no format fits, or several (what was looked for and what was found is
            listed); or an entry is missing, has the wrong shape, or is not finite.
        UnsafePickleError: a pickle asks for more than data.
    """
    source = open_source(path)
    options = ReadOptions(
        body=body, fps=fps, up=up, person=person, joint_map=joint_map, scale=scale,
        flat_hand_mean=flat_hand_mean,
    )  # fmt: skip
    chosen = _guarded(source, "a motion", lambda: _chosen(source, format))
    motion = _guarded(source, chosen.title, lambda: chosen.read(source, options))
    for notice in motion.notices:
        warnings.warn(notice, MotionNotice, stacklevel=2)
    return motion


def save_motion(
    path: str | Path,
    motion: Motion,
    *,
    format: str | None = None,
    body: BodyModel | None = None,
) -> Path:
    """Write a motion, in the format that the name of the path asks for.

    What a format cannot hold is said in a `MotionNotice`. Nothing is half-written.

    Args:
        path: `.npz` for AMASS, `.bvh`, `.npy` for X-Avatar's pose vectors, `.pkl` for one pose, or
            a folder for a pose pickle of every frame.
        motion: the motion.
        format: "amass", "bvh", "poses" or "xavatar", whatever the path's name.
        body: the body that moves; needed for all but AMASS. With it the motion is turned to the
            up axis of the format.

    Raises:
        ValueError: no such format, no body, or a motion that the format does not take.
    """
    suffix = Path(path).suffix.lower()
    name = format if format is not None else _SUFFIXES.get(suffix)
    if name not in WRITERS:
        raise ValueError(
            f"{path}: no format {format!r} to write; there are {', '.join(WRITERS)}."
            if format is not None
            else f"{path}: nothing is written to {suffix!r} files. Use .npz (AMASS), .bvh, .npy "
            "(X-Avatar), .pkl (one pose) or a folder, or pass format=."
        )
    if body is not None and name != "bvh":
        motion = motion.to_z_up(body) if name == "amass" else motion.to_y_up(body)
    if name == "amass":
        return amass.save_amass(path, motion)
    if body is None:
        use = "skeleton" if name == "bvh" else "mean hand"
        raise ValueError(f"{path}: pass body=, whose {use} the format {name!r} needs.")
    writer = {"bvh": bvh.save_bvh, "poses": pose_pickle.save_poses, "xavatar": xavatar.save_xavatar}
    return writer[name](path, motion, body)


def _guarded(source: Source, title: str, call: Callable[[], _T]) -> _T:
    """What the call returns; whatever a damaged file makes it raise names the file."""
    try:
        return call()
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError) as error:
        raise ValueError(
            f"{source.path}: looks like {title}, but cannot be read as such "
            f"({type(error).__name__}: {error})."
        ) from error
    except ValueError as error:
        if str(source.path) in str(error):
            raise
        raise ValueError(f"{source.path}: {error}") from error


def _chosen(source: Source, name: str | None) -> Format:
    if name is not None:
        if name not in FORMATS:
            raise ValueError(f"No motion format {name!r}; there are {', '.join(FORMATS)}.")
        chosen = FORMATS[name]
        if not chosen.recognise(source):
            raise ValueError(
                f"{source.path}: not of the format {name}; looked for {chosen.sought}; found "
                f"{source.describe()}."
            )
        return chosen
    own = [entry for entry in FORMATS.values() if entry is not params.FORMAT]
    # Parameters by name are in files of other formats too, which know more of them.
    fitting = [entry for entry in own if entry.recognise(source)] or [
        entry for entry in (params.FORMAT,) if entry.recognise(source)
    ]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(entry.name for entry in fitting)
        raise ValueError(
            f"{source.path}: could be {names}; found {source.describe()}. Say which with format=."
        )
    reason = explain(source)
    if reason:
        raise ValueError(f"{source.path}: {reason}")
    sought = "".join(f"\n  {entry.name}: {entry.sought}" for entry in FORMATS.values())
    raise ValueError(
        f"{source.path}: not recognised as a motion; found {source.describe()}. Looked for{sought}"
    )
