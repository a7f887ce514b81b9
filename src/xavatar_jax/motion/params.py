"""Motions and poses as parameters by name: in one file, or a file for each frame.

The parameters are SMPL-X's, SMPL-H's or SMPL's, in any container and under any of the names that
`content` knows; results of GVHMR, WHAM, TRAM, PromptHMR, ROMP and GLAMR are such files. Hands are
relative to the mean hand unless all rotations stand in one array, or the file's `flat_hand_mean`
or the caller says otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..body import SMPL_TREE, SMPLH_TREE, SMPLX_TREE, pose_groups
from ..kinematics import KinematicTree
from .content import (
    WHOLE,
    Parameters,
    People,
    canonical,
    find_people,
    joint_count,
    row_count,
    shape_of,
)
from .editing import fill_gaps, from_camera
from .format import (
    BODY_ONLY,
    Format,
    ReadOptions,
    Source,
    choose_person,
    open_source,
)
from .record import Motion, UpAxis, rest_pelvis
from .values import (
    Side,
    absolute_hands,
    doubled_mean_notice,
    listing,
    numbers,
    one_shape,
    per_frame,
    rotation_vectors,
    text,
)

_GROUPS = pose_groups(SMPLX_TREE)
_HANDS: dict[str, Side] = {"left_hand_pose": "left", "right_hand_pose": "right"}


_TREES = {22: SMPLX_TREE, 24: SMPL_TREE, 52: SMPLH_TREE, 55: SMPLX_TREE}
_MODELS = {SMPL_TREE: "smpl", SMPLH_TREE: "smplh", SMPLX_TREE: "smplx"}


@dataclass(frozen=True)
class Frames:
    """Numbers of T frames: poses of the tree's J joints with absolute hands, and the rest."""

    poses: Float[np.ndarray, "T J 3"]
    transl: Float[np.ndarray, "T 3"]
    betas: Float[np.ndarray, "T S"]
    expression: Float[np.ndarray, "T E"]
    tree: KinematicTree = SMPLX_TREE


def read_frames(
    data: Mapping[str, Any],
    where: str | Path,
    options: ReadOptions,
    notices: list[str],
    *,
    relative: bool = True,
) -> Frames:
    """Numbers of all frames that parameters by name hold; what is missing is zero, with a notice.

    Rotations are `global_orient` and `body_pose`, of 21 joints for SMPL-X or 23 for SMPL, or one
    array `poses` of all joints. `scale` and `translation` place the body, v' = scale * v +
    translation; a motion has scale 1, so positions are divided by it.

    Args:
        data: parameters by any of the names in `ALIASES`, of one frame or of T.
        where: file, for messages.
        options: `body` for the mean hand and components, `flat_hand_mean`.
        notices: what is missing is added.
        relative: whether hands are relative to the mean where neither file nor caller says.

    Raises:
        ValueError: no rotations of the body, or a value of another shape.
    """
    found = canonical(data).data
    whole = "poses" in found
    if "flat_hand_mean" in found:
        relative = not bool(np.asarray(found["flat_hand_mean"]))
    if options.flat_hand_mean is not None:
        relative = not options.flat_hand_mean
    if whole:
        poses, tree = _whole(found, where)
    else:
        poses, tree = _parts(found, data, where, options, relative=relative)
    count = len(poses)
    if tree is SMPL_TREE and not (options.body is not None and options.body.kind == "smpl"):
        _note(notices, BODY_ONLY)
    face = tree is SMPLX_TREE
    wanted = [*(_GROUPS if face and not whole else ()), "transl", "betas", "expression"]
    given = found.keys() | ({"transl"} if found.keys() & {"translation", "root_trans"} else set())
    absent = [n for n in wanted if n not in given and (face or n != "expression")]
    if absent:
        _note(notices, f"no {', '.join(absent)}: zero is used")
    betas, expression = (
        per_frame(found.get(name, np.zeros(0)), count, name=name, where=where)
        for name in ("betas", "expression")
    )
    transl = _position(found, count, where, options, notices, betas)
    return Frames(poses, transl, betas, expression, tree)


def _whole(found: dict[str, Any], where: str | Path) -> tuple[np.ndarray, KinematicTree]:
    """All rotations `(T, J, 3)` from one array, whose first joint may stand apart."""
    joints = joint_count(found["poses"])
    root = joints in (21, 23) and "global_orient" in found
    if joints is None or joints + root not in WHOLE:
        raise ValueError(
            f"{where}: poses has shape {shape_of(found['poses'])}; expected the rotations of "
            f"{', '.join(map(str, WHOLE))} joints, axis-angle or matrices."
        )
    poses = rotation_vectors(found["poses"], joints, name="poses", where=where)
    if root:
        first = rotation_vectors(
            found["global_orient"], 1, name="global_orient", where=where, count=len(poses)
        )
        poses = np.concatenate([first, poses], axis=1)
    tree = _TREES[joints + root]
    missing = tree.num_joints - poses.shape[1]  # hands and face, which are at rest
    return np.pad(poses, ((0, 0), (0, missing), (0, 0))), tree


def _parts(
    found: dict[str, Any],
    data: Mapping[str, Any],
    where: str | Path,
    options: ReadOptions,
    *,
    relative: bool,
) -> tuple[np.ndarray, KinematicTree]:
    """All rotations `(T, J, 3)` from those of parts of the body."""
    missing = [name for name in ("global_orient", "body_pose") if name not in found]
    if missing:
        raise ValueError(f"{where}: no {' and no '.join(missing)}; found {listing(data)}.")
    _refuse_embedding(shape_of(found["body_pose"]), where)
    joints = 23 if joint_count(found["body_pose"]) == 23 else 21
    body_pose = rotation_vectors(found["body_pose"], joints, name="body_pose", where=where)
    count = len(body_pose)
    if joints == 23:
        root = rotation_vectors(
            found["global_orient"], 1, name="global_orient", where=where, count=count
        )
        return np.concatenate([root, body_pose], axis=1), SMPL_TREE
    poses = np.zeros((count, SMPLX_TREE.num_joints, 3))
    poses[:, list(_GROUPS["body_pose"])] = body_pose
    for name, group in _GROUPS.items():
        if name == "body_pose" or name not in found:
            continue
        if name in _HANDS:
            poses[:, list(group)] = absolute_hands(
                found[name], _HANDS[name], relative=relative, options=options, name=name,
                where=where, count=count,
            )  # fmt: skip
        else:
            poses[:, list(group)] = rotation_vectors(
                found[name], len(group), name=name, where=where, count=count
            )
    return poses, SMPLX_TREE


def _position(
    found: dict[str, Any],
    count: int,
    where: str | Path,
    options: ReadOptions,
    notices: list[str],
    betas: np.ndarray,
) -> Float[np.ndarray, "T 3"]:
    """Translations at scale 1, metres."""
    scale = {
        name: per_frame(
            numbers(found.get(name, 1), name, where).reshape(-1, 1), count, name=name, where=where
        )
        for name in ("scale", "scaling")
    }
    moves = {
        name: per_frame(found.get(name, np.zeros(3)), count, name=name, where=where, width=3)
        for name in ("transl", "translation", "root_trans")
    }
    for name, values in scale.items():
        if not values.min() > 0:
            raise ValueError(f"{where}: {name} is {values.min():g}, expected numbers above zero.")
        if np.abs(values - 1).max() > 1e-5:
            _note(
                notices,
                f"{name} of {values.min():.4g} to {values.max():.4g}: a motion has scale 1, so the "
                "body keeps its own size and its positions are divided by the scale",
            )
    if "root_trans" in found:  # where the pelvis is, not how far it moves
        if options.body is None:
            raise ValueError(
                f"{where}: root_trans is the position of the pelvis. Pass body=xa.load_body(...), "
                "whose own pelvis is needed to get the translation from it."
            )
        alike = options.body.kind == "smpl" and betas.size
        pelvis = rest_pelvis(options.body, betas.mean(axis=0) if alike else np.zeros(0))
        return moves["root_trans"] / scale["scale"] - pelvis
    return moves["transl"] / scale["scaling"] + moves["translation"] / scale["scale"]


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
    for name, side in _HANDS.items() if frames.tree is SMPLX_TREE else ():
        notice = doubled_mean_notice(frames.poses[:, list(_GROUPS[name])], options.body, side)
        if notice:
            notices.append(notice)
    return Motion(
        poses=frames.poses,
        transl=frames.transl,
        joint_names=frames.tree.names,
        fps=options.frame_rate(notices),
        betas=shape,
        expression=frames.expression,
        up=up,
        gender=gender,
        source=str(path),
        notices=tuple(f"{path}: {notice}" for notice in notices),
        model=_MODELS[frames.tree],
    )


def read_named(file: Path) -> dict[str, Any]:
    """What a file of parameters holds, by name, in whatever container.

    Raises:
        ValueError: it holds something else.
    """
    data = open_source(file).data
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
        parts.append(part)
    return _joined(parts, files)


def _joined(parts: Sequence[Frames], places: Sequence[Any]) -> Frames:
    """Frames one after another; `places` name them in messages."""
    first = parts[0]
    for part, place in zip(parts, places, strict=True):
        if part.tree is not first.tree:
            model, expected = (_MODELS[p.tree] for p in (part, first))
            raise ValueError(f"{place}: poses of {model}, but of {expected} in {places[0]}.")
        for name in ("betas", "expression"):
            size, expected = (getattr(p, name).shape[1] for p in (part, first))
            if size != expected:
                raise ValueError(
                    f"{place}: {size} {name}, but {expected} in {places[0]}; all frames must hold "
                    "the same."
                )
    names = ("poses", "transl", "betas", "expression")
    arrays = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
    return Frames(**arrays, tree=first.tree)


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


_FRAME_FILE = r"(?!\d+\.npz)\D*(\d+)\.(?:json|npz|npy|pkl|pickle|pt|pth)"


def _people(source: Source) -> People:
    """Parameters by person, of a file or of a folder with a file for each frame."""
    if source.kind != "folder":
        return find_people(source)
    people: People = {}
    for number, files in numbered(source, _FRAME_FILE, ("params", "smpl", "smplx")).items():
        for person, parts in find_people(open_source(files[0])).items():
            if len(parts) > 1:
                raise ValueError(f"{files[0]}: {len(parts)} frames, where a file holds one.")
            entry = replace(parts[0][0], path=(str(files[0]), *parts[0][0].path))
            people.setdefault(person, []).append((entry, number))
    return people


def _recognise(source: Source) -> bool:
    if source.kind != "folder":
        return bool(find_people(source))
    files = numbered(source, _FRAME_FILE, ("params", "smpl", "smplx"))
    first = find_people(open_source(next(iter(files.values()))[0])) if files else {}
    return bool(first) and all(
        len(parts) == 1 and row_count(parts[0][0].data) == 1 for parts in first.values()
    )


def _read(source: Source, options: ReadOptions) -> Motion:
    path, people = source.path, _people(source)
    counts = {person: sum(row_count(p.data) for p, _ in ps) for person, ps in people.items()}
    parts = people[choose_person(counts, options.person, path)]
    first = parts[0][0]
    notices: list[str] = []
    places = [_place(path, entry) for entry, _ in parts]
    frames = _joined(
        [
            read_frames(entry.data, place, options, notices)
            for (entry, _), place in zip(parts, places, strict=True)
        ],
        places,
    )
    ignored = sorted({name for entry, _ in parts for name in entry.ignored})
    if ignored:
        notices.append(f"ignored entries: {', '.join(ignored)}")
    said = options.flat_hand_mean is not None or "flat_hand_mean" in first.data
    if not said and first.data.keys() & _HANDS.keys():
        notices.append("hands are taken as relative to the mean hand (flat_hand_mean=False)")
    if isinstance(source.data, np.ndarray):
        notices.append(
            f"rows of {source.data.shape[1]} numbers are taken as rotations of "
            f"{frames.tree.num_joints} joints, axis-angle"
        )
    up = _up_axis(first, path, options, notices)
    if options.fps is None and "fps" in first.data:
        options = replace(options, fps=float(numbers(first.data["fps"], "fps", path).flat[0]))
    gender = text(first.data["gender"]).lower() if "gender" in first.data else "unknown"
    motion = to_motion(frames, path, options, notices, up=up, gender=gender)
    if first.space == "camera":
        motion = from_camera(motion, options.body)
    order = [number for _, number in parts if number is not None]
    if len(parts) == 1:
        order = np.ravel(first.data.get("frames", [])).tolist()
    return fill_gaps(motion, order) if len(order) == len(motion) else motion


def _place(path: Path, entry: Parameters) -> str:
    """File and entry, for messages."""
    if entry.path and entry.path[0].startswith(str(path)):  # a file of a folder
        return ", ".join(entry.path)
    return f"{path}, {'.'.join(entry.path)}" if entry.path else str(path)


def _up_axis(entry: Parameters, path: Path, options: ReadOptions, notices: list[str]) -> UpAxis:
    if entry.space == "camera":
        return options.turned(str(path))
    if entry.space is None and options.up is None:
        notices.append("the world is taken as y-up; pass up= if it is not")
    # Only GLAMR gives the position of the pelvis; its world is z-up.
    return options.up or ("z" if "root_trans" in entry.data else "y")


def _refuse_embedding(shape: tuple[int, ...], where: str | Path) -> None:
    if shape[-1:] == (32,):
        raise ValueError(
            f"{where}: body_pose has shape {shape}: 32 numbers are an embedding of a pose prior "
            "(VPoser), not rotations of joints. Decode it with that prior, and save the 63 numbers "
            "of body_pose that it gives."
        )


def _note(notices: list[str], notice: str) -> None:
    if notice not in notices:
        notices.append(notice)


FORMAT = Format(
    name="params",
    title="body parameters by name",
    sought="global_orient and body_pose, or poses of 24, 52 or 55 joints, in a pickle, .npz, .npy, "
    "PyTorch or JSON file of one frame or many, in a folder of such files, or rows of 322 or 165",
    recognise=_recognise,
    read=_read,
)
