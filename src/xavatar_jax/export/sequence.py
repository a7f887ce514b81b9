"""A folder of mesh files, one a frame."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, get_args

from ..files import atomic_folder
from ..meshing import Mesh
from .meshes import write_obj, write_ply

SequenceFormat = Literal["ply", "obj"]
"""File formats of mesh sequences."""


def write_sequence(
    folder: str | os.PathLike[str],
    meshes: Iterable[Mesh],
    count: int,
    *,
    format: SequenceFormat = "ply",
    done: Callable[[int], Any] = lambda frames: None,
) -> list[str]:
    """Write `count` meshes as `frame_0000.ply` and so on into a new folder; gives their paths.

    Metres. `done` is called with 1 after each frame. The folder appears with all frames in it, or
    not at all.

    Raises:
        FileExistsError: if there is something at `folder` already.
        ValueError: for another format.
        OSError: if it cannot be written.
    """
    if format not in get_args(SequenceFormat):
        raise ValueError(f"unknown format {format!r}: {', '.join(get_args(SequenceFormat))}")
    target = Path(folder)
    if target.exists():
        raise FileExistsError(f"{target}: there already; name a new folder, or remove this one")
    write = {"ply": write_ply, "obj": write_obj}[format]
    digits = max(4, len(str(count - 1)))
    names = []
    with atomic_folder(target) as temporary:
        for k, mesh in enumerate(meshes):
            names.append(f"frame_{k:0{digits}d}.{format}")
            write(temporary / names[-1], mesh)
            done(1)
    return [str(target / name) for name in names]
