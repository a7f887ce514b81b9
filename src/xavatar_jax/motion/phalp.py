"""Reading what 4D-Humans and PHALP estimate and track: SMPL, so the body only.

The result (joblib) is a dictionary by frame name. A frame's entry lists `tid` (a number for each
person), `smpl` (rotation matrices), `camera` (translations in camera axes), `tracked_time` (frames
since the person was last seen; 0 is seen) and has its number in `time`.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ..body import SMPL_TREE
from .editing import fill_gaps, from_camera
from .format import BODY_ONLY, Format, ReadOptions, Source, choose_person
from .record import Motion
from .values import check_finite, one_shape, rotation_vectors


def _frames(data: Any) -> list[dict[str, Any]]:
    """Entries of all frames in order, or none if this is not such a file."""
    if not isinstance(data, dict) or not data:
        return []
    entries = list(data.values())
    if not all(isinstance(e, dict) and {"smpl", "tid"} <= e.keys() for e in entries):
        return []
    return [entry for _, entry in sorted(enumerate(entries), key=lambda e: _time(e[1], e[0]))]


def _time(entry: dict[str, Any], index: int) -> int:
    return int(np.asarray(entry.get("time", index)).reshape(-1)[0])


def _seen(entry: dict[str, Any]) -> list[int]:
    """Places of those people in an entry's lists that were seen in the frame."""
    count = min(len(entry["tid"]), len(entry["smpl"]))
    ages = np.asarray(entry.get("tracked_time", np.zeros(count)), np.float64).reshape(-1)
    return [k for k in range(count) if k >= len(ages) or ages[k] == 0]


def _read(source: Source, options: ReadOptions) -> Motion:
    path, up = source.path, options.turned(str(source.path))
    entries = _frames(source.data)
    people = Counter(int(entry["tid"][k]) for entry in entries for k in _seen(entry))
    person = choose_person(people, options.person, path)
    notices = [BODY_ONLY]
    numbers, smpl, places, shots = [], [], [], 0
    for index, entry in enumerate(entries):
        chosen = [k for k in _seen(entry) if int(entry["tid"][k]) == person]
        if not chosen:
            continue
        if numbers:
            shots += int(bool(entry.get("shot", 0)))
        numbers.append(_time(entry, index))
        smpl.append(entry["smpl"][chosen[0]])
        if "camera" in entry:
            places.append(np.asarray(entry["camera"][chosen[0]], np.float64).reshape(-1))
    if shots:
        notices.append(f"the film cuts {shots} times while the person is tracked")
    transl = _translations(places, len(smpl), notices, path)
    parts = (("global_orient", 1), ("body_pose", 23))
    pose = np.concatenate([_stacked(smpl, name, n, path) for name, n in parts], axis=1)
    betas = one_shape([np.asarray(s.get("betas", np.zeros(10))).reshape(-1) for s in smpl], notices)
    motion = Motion(
        poses=pose,
        transl=transl,
        joint_names=SMPL_TREE.names,
        fps=options.frame_rate(notices),
        betas=betas,
        up=up,
        source=str(path),
        notices=tuple(f"{path}: {notice}" for notice in notices),
        model="smpl",
    )
    return fill_gaps(from_camera(motion, options.body), numbers)


def _stacked(smpl: list[dict[str, Any]], name: str, joints: int, path: Path) -> np.ndarray:
    if any(name not in entry for entry in smpl):
        raise ValueError(f"{path}: no {name} in smpl; found {', '.join(sorted(smpl[0]))}.")
    parts = [
        rotation_vectors(s[name], joints, name=f"smpl.{name}", where=path, count=1) for s in smpl
    ]
    return np.concatenate(parts)


def _translations(
    places: list[np.ndarray], count: int, notices: list[str], path: Path
) -> np.ndarray:
    if len(places) != count or any(place.shape != (3,) for place in places):
        notices.append("no camera translation for every frame: the person stays in place")
        return np.zeros((count, 3))
    notices.append("distances from the camera rest on an assumed focal length")
    transl = np.stack(places)
    check_finite(transl, "camera", path)
    return transl


FORMAT = Format(
    name="phalp",
    title="4D-Humans or PHALP results (body only)",
    sought="a joblib pickle of a dictionary by frame with smpl and tid in every frame",
    recognise=lambda source: bool(_frames(source.data)),
    read=_read,
)
