"""`load_data`: recognise the layout of a folder and load it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..body import BodyModel
from ..motion import load_motion
from ..motion.values import read_gender
from .capture import Capture
from .grab import find_motions, load_grab
from .scans import find_frames, find_subject, load_folder, load_prepared

_LAYOUTS = (
    "train/*.npz and test/*.npz (AMASS or GRAB sequences)",
    "*.npz (a subject's AMASS or GRAB sequences, to be split)",
    "{train,test}/SEQUENCE/SMPLX/mesh-f*_smplx.{ply,pkl} (prepared, or X-Humans with meshes_pkl "
    "beside SMPLX), here or one folder down",
    "NAME.ply|obj beside NAME.npz|pkl (meshes with parameters), subfolders as sequences",
)


def load_data(
    data_dir: str | Path,
    body: BodyModel,
    *,
    gender: str | None = None,
    test: Sequence[str] | None = None,
    split_seed: int = 0,
    flat_hand_mean: bool | None = None,
    verbose: bool = False,
) -> Capture:
    """Load a capture in whichever known layout `data_dir` has.

    Args:
        data_dir: see `load_grab`, `load_prepared` and `load_folder` for the layouts.
        body: the body the parameters are for.
        gender: overrides what the files state.
        test: names of sequences to hold out, if the folder is not split.
        split_seed: seed of the split if neither the folder nor `test` defines it.
        flat_hand_mean: for meshes with parameters beside them, as in `load_frames` (absolute by
            default). The other layouts define it.
        verbose: show a progress bar.

    Raises:
        FileNotFoundError: no such folder, or no known layout in it; lists the layouts looked for
            and what is there.
        ValueError: as the loader of the layout, or `flat_hand_mean` for a layout that defines it.
    """
    data_dir = Path(data_dir).expanduser()
    if not data_dir.is_dir():
        raise FileNotFoundError(f"No data folder at {data_dir}.")
    options: dict[str, Any] = {"gender": gender, "test": test, "verbose": verbose}
    if find_motions(data_dir):
        _refuse_hands(data_dir, flat_hand_mean, "absolute")
        return load_grab(data_dir, body, split_seed=split_seed, **options)
    subject = find_subject(data_dir)
    if subject is not None:
        _refuse_hands(data_dir, flat_hand_mean, "relative to the mean hand")
        return load_prepared(subject, body, **options)
    if find_frames(data_dir)[0]:
        flat = flat_hand_mean is not False
        return load_folder(data_dir, body, split_seed=split_seed, flat_hand_mean=flat, **options)
    raise FileNotFoundError(_unknown_layout(data_dir))


def find_gender(data_dir: str | Path) -> str | None:
    """The gender that a capture's files state, or None; useful to choose the body.

    Reads one sequence or `gender.txt`.

    Raises:
        FileNotFoundError: no such folder.
    """
    data_dir = Path(data_dir).expanduser()
    if not data_dir.is_dir():
        raise FileNotFoundError(f"No data folder at {data_dir}.")
    motions = [file for files in find_motions(data_dir).values() for file in files]
    if motions:
        gender = load_motion(motions[0]).gender
        return None if gender == "unknown" else gender
    file = (find_subject(data_dir) or data_dir) / "gender.txt"
    return read_gender(file) if file.is_file() else None


def _refuse_hands(data_dir: Path, flat_hand_mean: bool | None, known: str) -> None:
    if flat_hand_mean is not None:
        raise ValueError(f"{data_dir}: hands are {known} in this layout; leave out flat_hand_mean.")


def _unknown_layout(data_dir: Path) -> str:
    present = sorted(p.name + ("/" if p.is_dir() else "") for p in data_dir.iterdir())
    shown = ", ".join(present[:12]) + (f" and {len(present) - 12} more" if present[12:] else "")
    wanted = "\n  ".join(_LAYOUTS)
    return f"{data_dir}: no known layout. Looked for\n  {wanted}\nFound: {shown or 'nothing'}."
