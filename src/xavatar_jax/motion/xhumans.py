"""Reading the sequences of X-Humans: a pickle of SMPL-X parameters for every frame.

`SUBJECT/{train,test}/TAKE/SMPLX/mesh-fNNNNN_smplx.pkl`, y-up, hands relative to the mean hand.
The subject's `mean_shape_smplx.npy` takes the place of the frames' shapes, and `gender.txt` says
the gender. Per-frame poses that this library writes have the same layout.
"""

from __future__ import annotations

from pathlib import Path

from .editing import fill_gaps
from .format import Format, ReadOptions, Source
from .params import numbered, read_files, to_motion
from .record import Motion
from .values import read_gender, read_mean_shape

_PATTERN = r"mesh-f(\d+)_smplx\.pkl"


def _recognise(source: Source) -> bool:
    return bool(numbered(source, _PATTERN, ("SMPLX",)))


def _read(source: Source, options: ReadOptions) -> Motion:
    files = numbered(source, _PATTERN, ("SMPLX",))
    chosen = [paths[0] for paths in files.values()]
    notices: list[str] = []
    frames = read_files(chosen, options, notices)
    folders = list(chosen[0].parents)[:4]  # SMPLX, the take, its split, the subject
    shape = _first(folders, "mean_shape_smplx.npy")
    gender = _first(folders, "gender.txt")
    motion = to_motion(
        frames,
        source.path,
        options,
        notices,
        up=options.up or "y",
        betas=None if shape is None else read_mean_shape(shape),
        gender="unknown" if gender is None else read_gender(gender),
    )
    return fill_gaps(motion, list(files))


def _first(folders: list[Path], name: str) -> Path | None:
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


FORMAT = Format(
    name="xhumans",
    title="X-Humans sequence",
    sought="a folder with mesh-fNNNNN_smplx.pkl files, or with a folder SMPLX of them",
    recognise=_recognise,
    read=_read,
)
