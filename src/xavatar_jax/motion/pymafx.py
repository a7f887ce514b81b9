"""Reading what PyMAF-X estimates from video, as it is or smoothed by X-Avatar's script.

The result (joblib) holds `smplx_params`, a list of batches with rotation matrices: `body_pose` has
24 joints, of which the first is the root and the last two are SMPL's hands. The smoothed one holds
one dictionary of axis-angle arrays. Camera axes; hands are absolute.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from .editing import fill_gaps, from_camera
from .format import Format, ReadOptions, Source, choose_person
from .params import read_frames, to_motion
from .record import Motion
from .values import rotation_vectors

_SMPL_JOINTS = 24


def _recognise(source: Source) -> bool:
    smoothed = {"body_pose", "left_hand_pose", "expression"} <= source.keys
    return "smplx_params" in source.keys or (smoothed and not source.keys & {"global_orient"})


def _read(source: Source, options: ReadOptions) -> Motion:
    path, up = source.path, options.turned(str(source.path))
    notices: list[str] = []
    raw = "smplx_params" in source.data
    data = _joined(source.data["smplx_params"], path) if raw else dict(source.data)
    body = rotation_vectors(data["body_pose"], _SMPL_JOINTS, name="body_pose", where=path)
    data |= {"global_orient": body[:, 0], "body_pose": body[:, 1:22]}
    if raw and "orig_cam_t" in source.data:
        data["transl"] = np.asarray(source.data["orig_cam_t"], np.float64)
        notices.append("distances from the camera rest on an assumed focal length")
    numbers = np.arange(len(body))
    if raw and "frame_ids" in source.data:
        rows, numbers = _rows(source.data, len(body), options.person, path)
        data = {
            name: rotations[rows] if len(rotations) == len(body) else rotations
            for name, rotations in ((n, np.asarray(v)) for n, v in data.items())
        }
    frames = read_frames(data, path, options, notices, relative=False)
    motion = to_motion(frames, path, options, notices, up=up)
    return fill_gaps(from_camera(motion, options.body), numbers.tolist())


def _joined(batches: Any, path: Path) -> dict[str, np.ndarray]:
    if not isinstance(batches, list | tuple) or not batches:
        raise ValueError(f"{path}: smplx_params is empty or no list of batches.")
    names = [n for n in batches[0] if all(n in b and b[n] is not None for b in batches)]
    if "body_pose" not in names:
        raise ValueError(f"{path}: no body_pose in smplx_params; found {', '.join(names)}.")
    joined = {}
    for name in names:
        try:
            joined[name] = np.concatenate([np.asarray(b[name], np.float64) for b in batches])
        except ValueError as error:
            raise ValueError(
                f"{path}: batches of smplx_params differ in {name} ({error})."
            ) from None
    return joined


def _rows(
    data: dict[str, Any], count: int, person: int | None, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of one person in the order of frames, and their frame numbers."""
    numbers = np.asarray(data["frame_ids"]).reshape(-1).astype(np.int64)
    people = np.array([_person(p) for p in data.get("person_ids", [])] or [0] * len(numbers))
    if len(numbers) != count or len(people) != count:
        raise ValueError(
            f"{path}: {count} poses, but {len(numbers)} frame_ids and {len(people)} person_ids."
        )
    if person is None and len(np.unique(numbers)) == count:
        chosen = np.arange(count)
    else:
        found, counts = np.unique(people, return_counts=True)
        who = choose_person(dict(zip(found.tolist(), counts.tolist(), strict=True)), person, path)
        chosen = np.flatnonzero(people == who)
    rows = chosen[np.argsort(numbers[chosen], kind="stable")]
    return rows, numbers[rows]


def _person(name: Any) -> int:
    """The number that a person's name ends in: `IMAGE_f12_p0` is person 0 of its frame."""
    match = re.search(r"(\d+)$", str(name))
    return int(match[1]) if match else 0


FORMAT = Format(
    name="pymafx",
    title="PyMAF-X results",
    sought="a joblib pickle with smplx_params, or a smoothed one with body_pose (T, 72) and no "
    "global_orient",
    recognise=_recognise,
    read=_read,
)
