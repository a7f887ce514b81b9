"""Body parameters in a nested dictionary of arrays, whatever names, nesting and people it has.

Archives, pickles, PyTorch files and JSON documents are such dictionaries once they are opened.
`find_people` looks in them for parameters of SMPL, SMPL-H or SMPL-X, and `canonical` gives every
spelling the name that SMPL-X uses.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from .format import Source, open_source

Space = Literal["world", "camera"]

ALIASES = {
    "global_orient": ("global_orient", "root_orient", "root_pose", "orient"),
    "body_pose": ("body_pose", "pose_body"),
    "jaw_pose": ("jaw_pose", "pose_jaw"),
    "leye_pose": ("leye_pose", "left_eye_pose"),
    "reye_pose": ("reye_pose", "right_eye_pose"),
    "left_hand_pose": ("left_hand_pose", "lhand_pose"),
    "right_hand_pose": ("right_hand_pose", "rhand_pose"),
    "transl": ("transl", "trans", "cam_trans"),
    "betas": ("betas", "beta", "shape"),
    "expression": ("expression", "expressions", "expr"),
}
"""What files call the parameters of SMPL-X."""
RATES = ("mocap_frame_rate", "mocap_framerate", "framerate", "fps")
_OTHERS = {
    # Rotations of all joints; some estimators store them in several ways, the best comes first.
    "poses": ("fullpose", "full_pose", "rotmat", "poses", "pose", "thetas", "theta"),
    "translation": ("translation",),
    "root_trans": ("root_trans",),
    "scale": ("scale",),
    "scaling": ("scaling",),
    "frames": ("frames", "frame_ids", "frame"),
    "track_ids": ("track_ids", "track_id"),
    "fps": RATES,
    "gender": ("gender",),
    "flat_hand_mean": ("flat_hand_mean",),
}
_PREFIX = re.compile(r"(?:pred|smplx|smplh|smpl)_")
_ENDINGS: dict[str, Space | None] = {
    "_world": "world", "_global": "world", "": None, "_incam": "camera", "_cam": "camera",
}  # fmt: skip
_PLACES = {"global_orient", "transl", "translation", "root_trans"}
_METADATA = {"model_type", "surface_model_type", "use_pca", "num_pca_comps", "num_betas",
             "num_expression_coeffs", "mocap_time_length"}  # fmt: skip
_SHARED = {"frames", "fps", "gender", "betas", "transl", "translation", "scale", "scaling",
           "flat_hand_mean"}  # fmt: skip
_IMAGE = re.compile(r"\d\.[A-Za-z]\w*$")
_DEPTH = 4
# Joints of an array of all rotations: SMPL-X's without hands and face, SMPL's, SMPL-H's, SMPL-X's.
WHOLE = (22, 24, 52, 55)
_MOTION_X = (
    ("global_orient", 3), ("body_pose", 63), ("left_hand_pose", 45), ("right_hand_pose", 45),
    ("jaw_pose", 3), ("expression", 50), ("face_shape", 100), ("transl", 3), ("betas", 10),
)  # fmt: skip


@dataclass(frozen=True)
class Parameters:
    """Parameters of one person, of one frame or several.

    Attributes:
        data: values by SMPL-X's names, and `poses` for all rotations in one array.
        path: entries of the file that lead to them.
        space: axes in which the body stands, as the entries' names say.
        ignored: entries beside them that are not used.
    """

    data: dict[str, Any]
    path: tuple[str, ...] = ()
    space: Space | None = None
    ignored: tuple[str, ...] = ()


People = dict[int, list[tuple[Parameters, int | None]]]


def canonical(data: Mapping[Any, Any], path: tuple[str, ...] = ()) -> Parameters:
    """The entries of a dictionary by SMPL-X's names; parameters of the world before a camera's."""
    given = {str(key): value for key, value in data.items() if value is not None}
    plain = renamed = _renamed({k: k for k in given}, given)
    space: Space | None = next(
        (s for part in path for e, s in _ENDINGS.items() if e and part.endswith(e)), None
    )
    for ending, ends_in in _ENDINGS.items():
        renamed = plain
        if ending:
            ended = _renamed(
                {k.removesuffix(ending): k for k in given if k.endswith(ending)}, given
            )
            renamed = {k: v for k, v in plain.items() if k not in _PLACES} | ended
            if not ended.keys() & {"global_orient", "poses"}:
                continue
        if renamed.keys() & {"global_orient", "poses"}:
            space = ends_in or space
            break
    if space is None and any(name in given for name in ("cam", "pred_cam", "cam_trans")):
        space = "camera"
    if {"global_orient", "body_pose"} <= renamed.keys():
        renamed = {k: v for k, v in renamed.items() if k != "poses"}
    used = {key for key, _ in renamed.values()} | _METADATA
    values = {name: value for name, (_, value) in renamed.items()}
    return Parameters(values, path, space, tuple(sorted(given.keys() - used)))


def _renamed(keys: dict[str, str], given: dict[str, Any]) -> dict[str, tuple[str, Any]]:
    """Key and value of each known name; `keys` are the file's, by the name to look at."""
    plain: dict[str, str] = {}
    for name, key in keys.items():
        plain.setdefault(_PREFIX.sub("", name.lower(), count=1), key)
    plain |= {name: key for name, key in keys.items() if name in plain}  # exact names come first
    renamed = {}
    for name, aliases in (ALIASES | _OTHERS).items():
        key = next((plain[alias] for alias in aliases if alias in plain), None)
        if key is not None:
            renamed[name] = (key, given[key])
    return renamed


def shape_of(values: Any) -> tuple[int, ...]:
    """Shape of an array; empty for what is none."""
    try:
        return np.shape(values)
    except ValueError:  # lists of different lengths
        return ()


def joint_count(values: Any) -> int | None:
    """Joints of an array of rotations, by its last axes; None if they are not of rotations."""
    shape = shape_of(values)
    if len(shape) > 2 and shape[-2:] == (3, 3):
        return shape[-3]
    if len(shape) > 1 and shape[-1] == 3:
        return shape[-2]
    return shape[-1] // 3 if shape and shape[-1] and shape[-1] % 3 == 0 else None


def _rotations(data: Mapping[str, Any]) -> Any:
    """The array whose rows are frames: `body_pose`, else `poses`, else nothing."""
    return data.get("body_pose", data.get("poses", ()))


def _is_body(data: dict[str, Any]) -> bool:
    if "poses" in data:
        joints = joint_count(data["poses"])
        return joints in WHOLE or ("global_orient" in data and joints in (21, 23))
    return {"global_orient", "body_pose"} <= data.keys()


def _from_rows(rows: np.ndarray) -> dict[str, Any] | None:
    """Parameters in the columns of an array `(T, n)`, None for an unknown width."""
    if rows.ndim != 2 or rows.dtype.kind not in "iuf":
        return None
    if rows.shape[1] == 322:
        starts = np.cumsum([width for _, width in _MOTION_X])[:-1]
        parts = np.split(rows, starts, axis=1)
        named = {name: part for (name, _), part in zip(_MOTION_X, parts, strict=True)}
        return named | {"flat_hand_mean": True}
    return {"poses": rows} if rows.shape[1] in (72, 156, 165) else None


def _children(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        value = value.ravel().tolist()
    if isinstance(value, Mapping):
        yield from ((str(key), child) for key, child in value.items())
    elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        yield from ((str(key), child) for key, child in enumerate(value))


def _find(value: Any, path: tuple[str, ...] = ()) -> list[Parameters]:
    """Every dictionary of parameters, with what stands beside it for all of its frames."""
    if isinstance(value, np.ndarray) and value.dtype.kind != "O":
        rows = _from_rows(value)
        return [] if rows is None else [canonical(rows, path)]
    beside = canonical(value, path) if isinstance(value, Mapping) else Parameters({})
    if _is_body(beside.data):
        return [beside]
    if len(path) == _DEPTH:
        return []
    children = dict(_children(value))
    inside = {
        key: _find(child, (*path, key))
        for key, child in children.items()
        if len(children) == 1 or not isinstance(child, np.ndarray) or child.dtype.kind == "O"
    }
    shared = {name: entry for name, entry in beside.data.items() if name in _SHARED}
    unused = tuple(name for name in beside.ignored if not inside.get(name))
    return [
        replace(found, data=shared | found.data, ignored=(*unused, *found.ignored))
        for entries in inside.values()
        for found in entries
    ]


def find_people(source: Source) -> People:
    """Parameters by person: one entry of many frames, or one a frame with the frame's number.

    Where a file holds a body both in the world and in camera axes, those of the world are taken.
    Entries of a dictionary are frames if each holds one frame or is named after an image, and
    people otherwise.
    """
    found = _find(source.data) if source.kind not in ("folder", "bvh", "unknown") else []
    found = [entry for entry in found if entry.space == "world"] or found
    keys = [_distinct(entry, found) for entry in found]
    single = len(found) > 1 and all(row_count(entry.data) == 1 for entry in found)
    by_frame = single or any(_IMAGE.search(key) for key in keys)
    people: People = {}
    for place, (key, entry) in enumerate(zip(keys, found, strict=True)):
        digits = re.search(r"\d+(?=\D*$)", key.rsplit(".", 1)[0])
        number = int(digits[0]) if digits else place
        for person, part in _people_of(entry, by_frame):
            who = person if by_frame or len(found) == 1 else number
            people.setdefault(who, []).append((part, number if by_frame else None))
    for parts in people.values():
        parts.sort(key=lambda part: part[1] or 0)
    return people


def _distinct(entry: Parameters, others: list[Parameters]) -> str:
    """The part of an entry's path that tells it from the others; a single entry's if an image."""
    for depth, part in enumerate(entry.path):
        if any(other.path[depth : depth + 1] != (part,) for other in others):
            return part
    return entry.path[-1] if entry.path and _IMAGE.search(entry.path[-1]) else ""


def row_count(data: Mapping[str, Any]) -> int:
    """Frames of canonical parameters, or people where those of one frame stand together."""
    values = _rotations(data)
    shape, joints = shape_of(values), joint_count(values)
    size = 9 if len(shape) > 2 and shape[-2:] == (3, 3) else 3
    return int(np.prod(shape)) // (joints * size) if joints else 1


def _people_of(entry: Parameters, by_frame: bool) -> Iterator[tuple[int, Parameters]]:
    """The people whose rows stand together: `(P, T, n)`, or the P rows of one frame."""
    values = _rotations(entry.data)
    shape, joints = shape_of(values), joint_count(values) or 0
    together = len(shape) == 3 and shape[-1] == 3 * joints and shape[-1] > 3
    count = shape[0] if together else row_count(entry.data) if by_frame else 1
    if count == 1 and not together:
        yield 0, entry
        return
    ids = np.ravel(entry.data.get("track_ids", np.arange(count)))
    for k in range(count):
        data = {
            name: value[k] if together else value[k : k + 1]
            for name, value in entry.data.items()
            if shape_of(value)[:1] == (count,)
        }
        part = replace(entry, data=entry.data | data)
        yield int(ids[k]) if len(ids) == count else k, part


_MHR = {
    "mhr_model_params", "body_pose_params", "pred_pose_raw", "lbs_model_params", "identity_coeffs",
    "pred_global_rots", "face_expr_coeffs",
}  # fmt: skip


def explain(source: Source) -> str | None:
    """Why a file of body parameters is no motion and what to do, None if nothing is known of it."""
    if source.kind == "folder":
        files = [f for f in source.data if f.suffix in (".npz", ".npy", ".pkl", ".json", ".pt")]
        return explain(open_source(files[0])) if files else None
    names = set(_names(source.data))
    if names & _MHR:
        return (
            f"holds {', '.join(sorted(names & _MHR))}: a result of SAM 3D Body, for the body model "
            "MHR, whose joints and shape are not those of SMPL-X. Convert it to SMPL-X with MHR's "
            "own conversion tool (tools/mhr_smpl_conversion; MHR is in centimetres), and read the "
            "parameters that it gives."
        )
    latent = sorted(n for n in names if re.search(r"pose.*embedding|latent.*pose|pose.*latent", n))
    if latent:
        return (
            f"holds {', '.join(latent)}: an embedding of a pose prior (VPoser), not rotations of "
            "joints. Decode it with that prior, and save the 63 numbers of body_pose."
        )
    return None


def _names(value: Any, depth: int = 0) -> Iterator[str]:
    for key, child in _children(value):
        yield key.lower()
        if depth < _DEPTH:
            yield from _names(child, depth + 1)
