"""GRAB subjects: AMASS "SMPL-X G" archives, GRAB's own, or the reference's prepared folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..body import BodyModel, BodyParams, with_template
from ..files.meshes import read_mesh
from ..frames import Frames, frames_from_params
from ..motion import Motion, fit_to_body, load_motion
from .capture import (
    Capture,
    concatenate_params,
    notify,
    one_shape,
    resolve_gender,
    split_names,
)
from .scans import find_subject, ignored_meshes, load_prepared

# AMASS keeps a subject's shape fit beside its motions.
_NOT_MOTIONS = ("_stagei.npz", "shape.npz")


def load_grab(
    data_dir: str | Path,
    body: BodyModel,
    *,
    gender: str | None = None,
    test: Sequence[str] | None = None,
    split_seed: int = 0,
    fps: float | None = None,
    template: str | Path | Float[np.ndarray, "V 3"] | None = None,
    verbose: bool = False,
) -> Capture:
    """Load the sequences of one GRAB subject, split into training and test.

    Three layouts are read: `DIR/train/*.npz` and `DIR/test/*.npz`; a subject's own folder of
    `*.npz`; and the folders the reference implementation prepares (see `load_prepared`). The
    archives are AMASS "SMPL-X G" or GRAB's own. The frames' meshes are the surface of the body,
    posed on access; the z-up world of the files becomes y-up.

    Args:
        data_dir: the folder.
        body: the body model of the subject's gender.
        gender: overrides what the files state.
        test: names of sequences to hold out, if the folder is not split.
        split_seed: seed of the split otherwise: nine and three sequences, or 3:1 of fewer.
        fps: resample to this frame rate. None keeps the rate of each file; they may differ.
        template: the subject's own template (GRAB's `vtemp`), vertices or a mesh file in the
            body's topology. It replaces template and shape: joints are regressed from it, and
            betas are zero. None for the template that GRAB's own archives name, if any.
        verbose: show a progress bar.

    Raises:
        FileNotFoundError: no such folder, no sequences, or no template where one is needed.
        ValueError: as for `load_motion`, scans that would be ignored, genders that do not match,
            or names not found.
    """
    data_dir = Path(data_dir).expanduser()
    files = find_motions(data_dir)
    subject = None if files else find_subject(data_dir)
    if subject is not None:
        return load_prepared(subject, body, gender=gender, test=test, verbose=verbose)
    if not files:
        raise FileNotFoundError(
            f"{data_dir}: no sequences. Looked for train/*.npz and test/*.npz, for *.npz, and for "
            "{train,test}/SEQUENCE/SMPLX/mesh-f*_smplx.pkl."
        )
    train_files, test_files = _split(files, data_dir, test, split_seed)
    motions = _load_motions([*train_files, *test_files], fps, verbose)
    subject_gender, notices = resolve_gender(
        {m.source: m.gender for m in motions}, body, gender, data_dir
    )
    notices += ignored_meshes(data_dir)
    template = _find_template(motions, data_dir) if template is None else template
    if template is not None:
        body = with_template(body, _template_vertices(template, body))
        betas = np.zeros(0)
    else:
        betas, notice = one_shape({m.source: m.betas for m in motions})
        notices += [notice] if notice else []
    motions = [replace(m, betas=betas) for m in motions]
    recorded = notify(notices)
    unused = sum(map(len, files.values())) - len(motions)
    if unused:
        recorded += (f"{data_dir}: {unused} sequences used neither for training nor for testing.",)
    rates = sorted({motion.fps for motion in motions})
    if len(rates) > 1:
        listing = ", ".join(f"{rate:g}" for rate in rates)
        recorded += (f"{data_dir}: frame rates of {listing}; each sequence keeps its own.",)
    names = [_name(file) for file in (*train_files, *test_files)]
    split = len(train_files)
    fitted = [fit_to_body(motion.to_y_up(body), body) for motion in motions]
    recorded += tuple(n for m in motions for n in m.notices)
    recorded += tuple(n for _, fitting_notices in fitted for n in fitting_notices)
    params = [p for p, _ in fitted]
    train, test_frames = (
        _frames(motions[part], params[part], names[part], body)
        for part in (slice(split), slice(split, None))
    )
    return Capture(
        name=data_dir.name,
        body=body,
        train=train,
        test=test_frames,
        betas=np.asarray(train.params.betas[0], np.float64),
        gender=subject_gender,
        fps=rates[0] if len(rates) == 1 else float("nan"),
        notices=recorded,
    )


def find_motions(data_dir: Path) -> dict[str, list[Path]]:
    """Motion archives by split: "train" and "test", or "" for a folder without a split."""
    split = {part: _archives(data_dir / part) for part in ("train", "test")}
    if any(split.values()):
        return split
    whole = _archives(data_dir)
    return {"": whole} if whole else {}


def _archives(folder: Path) -> list[Path]:
    """Motion archives in a folder, without the parameters of single meshes."""
    meshes = {p.stem for suffix in ("ply", "obj") for p in folder.glob(f"*.{suffix}")}
    return [
        p
        for p in sorted(folder.glob("*.npz"))
        if not p.name.endswith(_NOT_MOTIONS) and p.stem not in meshes and p.name[0] != "."
    ]


def _name(file: Path) -> str:
    return file.stem.removesuffix("_stageii")


def _split(
    files: dict[str, list[Path]], data_dir: Path, test: Sequence[str] | None, seed: int
) -> tuple[list[Path], list[Path]]:
    if "" not in files:
        empty = [part for part in ("train", "test") if not files[part]]
        if empty:
            raise FileNotFoundError(f"{data_dir / empty[0]}: no *.npz sequences in it.")
        if test is not None:
            raise ValueError(
                f"{data_dir} is split into train and test already; leave out the names of test "
                "sequences, or point to a folder without train/ and test/."
            )
        return files["train"], files["test"]
    by_name = {_name(file): file for file in files[""]}
    wanted = None if test is None else [_name(Path(f"{n.removesuffix('.npz')}.npz")) for n in test]
    train_names, test_names = split_names(list(by_name), test=wanted, seed=seed, source=data_dir)
    return [by_name[n] for n in train_names], [by_name[n] for n in test_names]


def _load_motions(files: list[Path], fps: float | None, verbose: bool) -> list[Motion]:
    from tqdm.auto import tqdm

    bar = tqdm(files, desc="reading sequences", unit="file", disable=None if verbose else True)
    motions = [load_motion(file) for file in bar]
    return motions if fps is None else [motion.resample(fps) for motion in motions]


def _find_template(motions: list[Motion], data_dir: Path) -> Path | None:
    """The template that GRAB's own archives name, relative to the dataset's root."""
    named = {motion.template for motion in motions} - {None}
    if not named:
        return None
    if len(named) > 1:
        raise ValueError(
            f"{data_dir}: sequences of different subjects: {', '.join(map(str, named))}."
        )
    relative = str(named.pop())
    roots = [data_dir.resolve(), *data_dir.resolve().parents]
    tried = [root / relative for root in roots]
    for path in tried:
        if path.is_file():
            return path
    raise FileNotFoundError(
        f"{data_dir}: the sequences name the subject's template {relative}, which is not below "
        f"{data_dir} or any folder above it. Pass template=."
    )


def _template_vertices(template, body: BodyModel) -> np.ndarray:
    if not isinstance(template, str | Path):
        return np.asarray(template)
    vertices, _ = read_mesh(template)
    if len(vertices) != body.num_vertices:
        raise ValueError(
            f"{template}: the template has {len(vertices)} vertices, but the body "
            f"({body.source.describe()}) has {body.num_vertices}."
        )
    return vertices


def _frames(
    motions: list[Motion], params: list[BodyParams], names: list[str], body: BodyModel
) -> Frames:
    return frames_from_params(
        body,
        concatenate_params(params),
        sources=[f"{m.source}, frame {i}" for m in motions for i in range(len(m))],
        sequence_names=names,
        sequence_index=np.repeat(np.arange(len(motions)), [len(m) for m in motions]),
    )
