"""Motions and poses as SMPL-X parameters by name: in one file, or a file for each frame.

The names are those of SMPL-X (`global_orient`, `body_pose`, ...), in a pickle or an archive. Hands
are relative to the mean hand unless the file's `flat_hand_mean` or the caller says otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..body import SMPLX_TREE, pose_groups
from ..files import load_npz, load_pickle
from .format import Format, ReadOptions, Source
from .record import Motion, UpAxis
from .values import (
    Side,
    absolute_hands,
    doubled_mean_notice,
    listing,
    one_shape,
    per_frame,
    rotation_vectors,
)

ALIASES = {
    "global_orient": ("global_orient", "root_orient"),
    "body_pose": ("body_pose", "pose_body"),
    "jaw_pose": ("jaw_pose", "pose_jaw"),
    "leye_pose": ("leye_pose",),
    "reye_pose": ("reye_pose",),
    "left_hand_pose": ("left_hand_pose",),
    "right_hand_pose": ("right_hand_pose",),
    "transl": ("transl", "trans"),
    "betas": ("betas", "shape"),
    "expression": ("expression", "expressions"),
}
"""What files call the parameters of SMPL-X."""
_GROUPS = pose_groups(SMPLX_TREE)
_HANDS: dict[str, Side] = {"left_hand_pose": "left", "right_hand_pose": "right"}


@dataclass(frozen=True)
class Frames:
    """Numbers of T frames: poses of SMPL-X's 55 joints with absolute hands, and the rest."""

    poses: Float[np.ndarray, "T 55 3"]
    transl: Float[np.ndarray, "T 3"]
    betas: Float[np.ndarray, "T S"]
    expression: Float[np.ndarray, "T E"]


def read_frames(
    data: Mapping[str, Any],
    where: str | Path,
    options: ReadOptions,
    notices: list[str],
    *,
    relative: bool = True,
) -> Frames:
    """Numbers of all frames that parameters by name hold; what is missing is zero, with a notice.

    Args:
        data: parameters by SMPL-X's names, of one frame or of T.
        where: file, for messages.
        options: `body` for the mean hand and components, `flat_hand_mean`.
        notices: what is missing is added.
        relative: whether hands are relative to the mean where neither file nor caller says.

    Raises:
        ValueError: no `global_orient` or `body_pose`, or a value of another shape.
    """
    found = {
        name: next((data[alias] for alias in aliases if data.get(alias) is not None), None)
        for name, aliases in ALIASES.items()
    }
    missing = [name for name in ("global_orient", "body_pose") if found[name] is None]
    if missing:
        raise ValueError(f"{where}: no {' and no '.join(missing)}; found {listing(data)}.")
    _refuse_smpl(np.asarray(found["body_pose"]), where)
    body_pose = rotation_vectors(found["body_pose"], 21, name="body_pose", where=where)
    count = len(body_pose)
    poses = np.zeros((count, SMPLX_TREE.num_joints, 3))
    poses[:, list(_GROUPS["body_pose"])] = body_pose
    if "flat_hand_mean" in data:
        relative = not bool(np.asarray(data["flat_hand_mean"]))
    if options.flat_hand_mean is not None:
        relative = not options.flat_hand_mean
    for name, joints in _GROUPS.items():
        if name == "body_pose" or found[name] is None:
            continue
        if name in _HANDS:
            poses[:, list(joints)] = absolute_hands(
                found[name], _HANDS[name], relative=relative, options=options, name=name,
                where=where, count=count,
            )  # fmt: skip
        else:
            poses[:, list(joints)] = rotation_vectors(
                found[name], len(joints), name=name, where=where, count=count
            )
    absent = [name for name, value in found.items() if value is None]
    if absent:
        _note(notices, f"no {', '.join(absent)}: zero is used")
    fields = {}
    for name, width in (("transl", 3), ("betas", None), ("expression", None)):
        value = np.zeros(width or 0) if found[name] is None else found[name]
        fields[name] = per_frame(value, count, name=name, where=where, width=width)
    return Frames(poses=poses, **fields)


def to_motion(
    frames: Frames,
    path: Path,
    options: ReadOptions,
    notices: list[str],
    *,
    up: UpAxis,
    betas: Float[np.ndarray, " S"] | None = None,
    gender: str = "unknown",
) -> Motion:
    """The motion that frames make, at the rate given or assumed.

    Args:
        frames: the frames.
        path: where they come from.
        options: frame rate and body.
        notices: what was assumed so far; more is added.
        up: axis that points up.
        betas: take the place of the frames' own.
        gender: of the body.
    """
    shape = one_shape(frames.betas, notices) if betas is None else betas
    for name, side in _HANDS.items():
        notice = doubled_mean_notice(frames.poses[:, list(_GROUPS[name])], options.body, side)
        if notice:
            notices.append(notice)
    return Motion(
        poses=frames.poses,
        transl=frames.transl,
        joint_names=SMPLX_TREE.names,
        fps=options.frame_rate(notices),
        betas=shape,
        expression=frames.expression,
        up=up,
        gender=gender,
        source=str(path),
        notices=tuple(f"{path}: {notice}" for notice in notices),
        model="smplx",
    )


def read_named(file: Path) -> dict[str, Any]:
    """What a pickle or an archive holds, by name.

    Raises:
        ValueError: it holds something else.
    """
    data = load_npz(file) if file.suffix.lower() == ".npz" else load_pickle(file)
    if not isinstance(data, dict):
        raise ValueError(f"{file}: holds a {type(data).__name__}, not parameters by name.")
    return data


def read_files(
    files: Sequence[Path], options: ReadOptions, notices: list[str], *, relative: bool = True
) -> Frames:
    """One frame from each file, in the order given.

    Raises:
        ValueError: naming the file that holds no frame, several, or other sizes than the first.
    """
    parts = []
    for file in files:
        part = read_frames(read_named(file), file, options, notices, relative=relative)
        if len(part.poses) != 1:
            raise ValueError(f"{file}: {len(part.poses)} frames, where a file holds one.")
        for name in ("betas", "expression"):
            size = getattr(part, name).shape[1]
            if parts and size != getattr(parts[0], name).shape[1]:
                raise ValueError(
                    f"{file}: {size} {name}, but {getattr(parts[0], name).shape[1]} in {files[0]}; "
                    "all frames must hold the same."
                )
        parts.append(part)
    names = ("poses", "transl", "betas", "expression")
    return Frames(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def numbered(folder: Source, pattern: str, subfolders: Sequence[str]) -> dict[int, list[Path]]:
    """Files of a folder by frame number, from it or the first of its subfolders that has some.

    Args:
        folder: a folder.
        pattern: of the whole file name; its first group is the number.
        subfolders: names to look into.
    """
    if folder.kind != "folder":
        return {}
    for parent in (folder.path, *(folder.path / name for name in subfolders)):
        found: dict[int, list[Path]] = {}
        for file in folder.data:
            match = re.fullmatch(pattern, file.name)
            if match and file.parent == parent:
                found.setdefault(int(match[1]), []).append(file)
        if found:
            return dict(sorted(found.items()))
    return {}


def _recognise(source: Source) -> bool:
    return source.kind in ("npz", "pickle") and {"global_orient", "body_pose"} <= source.keys


def _read(source: Source, options: ReadOptions) -> Motion:
    notices: list[str] = []
    frames = read_frames(source.data, source.path, options, notices)
    if "flat_hand_mean" not in source.data and options.flat_hand_mean is None:
        notices.append("hands are taken as relative to the mean hand (flat_hand_mean=False)")
    if options.up is None:
        notices.append("the world is taken as y-up; pass up= if it is not")
    return to_motion(frames, source.path, options, notices, up=options.up or "y")


def _refuse_smpl(body_pose: np.ndarray, where: str | Path) -> None:
    if body_pose.shape[-1:] == (32,):
        raise ValueError(
            f"{where}: body_pose has shape {body_pose.shape}: 32 numbers are an embedding of a "
            "pose prior (VPoser), not rotations of joints. Decode it with that prior, and save the "
            "63 numbers of body_pose that it gives."
        )
    if body_pose.shape[-1:] == (69,) or 23 in body_pose.shape[-3:]:
        raise ValueError(
            f"{where}: body_pose has shape {body_pose.shape}: 23 joints, which is SMPL. Parameters "
            "of SMPL-X have 21; convert the file with SMPL's own transfer tool."
        )


def _note(notices: list[str], notice: str) -> None:
    if notice not in notices:
        notices.append(notice)


FORMAT = Format(
    name="params",
    title="SMPL-X parameters by name",
    sought="a pickle or .npz with global_orient and body_pose, of one frame or many",
    recognise=_recognise,
    read=_read,
)
