"""Reading what SMPLer-X and SMPLest-X estimate: an archive for every frame and person.

`smplx/NNNNN_P.npz`, with P counting the people found in that frame. Camera axes, hands relative to
the mean hand; SMPLest-X leaves out the eyes.
"""

from __future__ import annotations

import re
from pathlib import Path

from ..files import load_npz
from .editing import fill_gaps, from_camera
from .format import Format, ReadOptions, Source, choose_person
from .params import numbered, read_files, to_motion
from .record import Motion

_PATTERN = r"(\d+)(?:_(\d+))?\.npz"


def _recognise(source: Source) -> bool:
    files = numbered(source, _PATTERN, ("smplx",))
    if not files:
        return False
    return {"global_orient", "body_pose"} <= load_npz(next(iter(files.values()))[0]).keys()


def _read(source: Source, options: ReadOptions) -> Motion:
    up = options.turned(str(source.path))
    files = numbered(source, _PATTERN, ("smplx",))
    # Numbers count the people of one frame: a person alone in it is the same as another.
    alone = options.person is None and all(len(found) == 1 for found in files.values())
    people: dict[int, dict[int, Path]] = {}
    for number, paths in files.items():
        for path in paths:
            match = re.fullmatch(_PATTERN, path.name)
            person = 0 if alone or match is None else int(match[2] or 0)
            people.setdefault(person, {})[number] = path
    counts = {person: len(found) for person, found in people.items()}
    chosen = people[choose_person(counts, options.person, source.path)]
    notices: list[str] = []
    frames = read_files(list(chosen.values()), options, notices)
    motion = to_motion(frames, source.path, options, notices, up=up)
    return fill_gaps(from_camera(motion, options.body), list(chosen))


FORMAT = Format(
    name="smplerx",
    title="SMPLer-X or SMPLest-X results",
    sought="a folder with NNNNN_P.npz files of global_orient and body_pose, or with a folder "
    "smplx of them",
    recognise=_recognise,
    read=_read,
)
