"""Subject folders of X-Humans, and those that X-Avatar's preparation writes from GRAB."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..body import BodyModel
from ..motion.values import read_gender, read_mean_shape
from .capture import Capture, notify, resolve_gender
from .mesh_frames import check_first_frame, mesh_frames, read_params

_PATTERN = "*/SMPLX/mesh-f*_smplx.pkl"
_MESH_PATTERN = "*/SMPLX/mesh-f*_smplx.ply"


def find_subject(data_dir: Path) -> Path | None:
    """The subject's folder: `data_dir`, or the only folder in it that is one; None if neither.

    Raises:
        ValueError: there are several subjects.
    """

    def is_subject(folder: Path) -> bool:
        return any(
            next((folder / part).glob(pattern), None) is not None
            for part in ("train", "test")
            for pattern in (_PATTERN, _MESH_PATTERN)
        )

    if not data_dir.is_dir():
        return None
    if is_subject(data_dir):
        return data_dir
    subjects = [p for p in sorted(data_dir.iterdir()) if p.is_dir() and is_subject(p)]
    if len(subjects) > 1:
        raise ValueError(
            f"{data_dir}: {len(subjects)} subjects ({', '.join(p.name for p in subjects)}); "
            "an avatar is of one person, so point to one of them."
        )
    return subjects[0] if subjects else None


def load_prepared(
    subject_dir: str | Path,
    body: BodyModel,
    *,
    gender: str | None = None,
    test: Sequence[str] | None = None,
    verbose: bool = False,
) -> Capture:
    """Load `SUBJECT/{train,test}/SEQUENCE/SMPLX/mesh-fNNNNNN_smplx.{ply,pkl}`.

    Where a sequence has scans beside `SMPLX` (`meshes_pkl/mesh-fNNNNNN.pkl` of X-Humans, or
    `meshes_ply`, `meshes_obj`), they are what is learned from; textures are not read.
    `gender.txt` and `mean_shape_smplx.npy` lie in the subject's folder; the mean shape takes the
    place of the frames' own betas. Meshes are read when asked for and are y-up already. Hands
    are relative to the mean hand in these files, so the body's mean hand is added.

    Args:
        subject_dir: the folder.
        body: the body model of the subject's gender.
        gender: takes the place of `gender.txt`.
        test: must be None; the folder is split already.
        verbose: show a progress bar.

    Raises:
        FileNotFoundError: a mesh or scan without parameters, or parameters without one.
        ValueError: parameters of the wrong shape, a pickle that is more than data, or a gender
            that does not match the body's.
    """
    subject_dir = Path(subject_dir)
    if test is not None:
        raise ValueError(f"{subject_dir} is split into train and test already; leave out test=.")
    pairs = {part: _pairs(subject_dir / part) for part in ("train", "test")}
    both = [*pairs["train"], *pairs["test"]]
    shape_file, gender_file = subject_dir / "mean_shape_smplx.npy", subject_dir / "gender.txt"
    shape = read_mean_shape(shape_file) if shape_file.is_file() else None
    found = {str(gender_file): read_gender(gender_file)} if gender_file.is_file() else {}
    subject_gender, notices = resolve_gender(found, body, gender, subject_dir)
    params, betas, more = read_params(
        both, body, betas=shape, flat_hand_mean=False, verbose=verbose
    )
    split = len(pairs["train"])
    train, held_out = (
        mesh_frames(both[part], [_sequence(mesh) for mesh, _ in both[part]], params[part], body)
        for part in (slice(split), slice(split, None))
    )
    more += check_first_frame(train, body, flat_hand_mean=False)
    return Capture(
        name=subject_dir.name,
        body=body,
        train=train,
        test=held_out,
        betas=betas,
        gender=subject_gender,
        fps=float("nan"),
        notices=notify([*notices, *more]),
    )


def _pairs(folder: Path) -> list[tuple[Path, Path]]:
    meshes = {p.with_suffix(""): p for p in folder.glob(_MESH_PATTERN)}
    params = {p.with_suffix(""): p for p in folder.glob(_PATTERN)}
    for sequence in sorted({name.parent.parent for name in meshes.keys() | params.keys()}):
        scans = _scans(sequence)
        if scans is not None:
            meshes = {name: p for name, p in meshes.items() if name.parent.parent != sequence}
            meshes |= scans
    for name in sorted(meshes.keys() ^ params.keys()):
        lacking = ".pkl parameters" if name in meshes else ".ply mesh"
        raise FileNotFoundError(f"{meshes.get(name) or params.get(name)}: no {lacking} beside it.")
    if not meshes:
        raise FileNotFoundError(f"{folder}: no frames; looked for {_PATTERN} with .ply beside.")
    return [(meshes[name], params[name]) for name in sorted(meshes)]


def _scans(sequence: Path) -> dict[Path, Path] | None:
    """Scans of a sequence, if it has a folder of them, by the name of their frame's parameters."""
    for suffix in ("pkl", "ply", "obj"):
        folder = sequence / f"meshes_{suffix}"
        if folder.is_dir():
            found = folder.glob(f"mesh-f*.{suffix}")
            return {sequence / "SMPLX" / f"{p.stem}_smplx": p for p in found}
    return None


def _sequence(mesh: Path) -> str:
    return mesh.parent.parent.name
