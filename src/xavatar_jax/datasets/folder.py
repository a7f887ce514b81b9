"""A plain folder of meshes with parameters beside them: how people bring their own data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..body import BodyModel
from ..frames import Frames
from ..motion.values import read_gender
from .capture import Capture, notify, resolve_gender, split_names
from .mesh_frames import check_first_frame, mesh_frames, read_params

_MESHES, _PARAMS = (".ply", ".obj"), (".npz", ".pkl")
_TEST_FRACTION = 0.25


def load_frames(
    folder: str | Path,
    body: BodyModel,
    *,
    betas: Float[np.ndarray, " S"] | None = None,
    flat_hand_mean: bool = True,
    verbose: bool = False,
) -> Frames:
    """Frames from `NAME.ply|obj` beside `NAME.npz|pkl`; subfolders are sequences.

    Parameters go by SMPL-X's names: `global_orient`, `body_pose`, `transl`, and as far as known
    `left_hand_pose`, `right_hand_pose`, `jaw_pose`, `leye_pose`, `reye_pose`, `betas`,
    `expression`. Shapes `(63,)`, `(1, 63)`, `(21, 3)` and rotation matrices are all read. Meshes
    are in metres, in the world of the parameters, y-up. They are read when asked for.

    Args:
        folder: the folder.
        body: the body the parameters are for.
        betas: the person's shape; None takes the one the files agree on, or their mean.
        flat_hand_mean: True if hand poses are absolute (zero is a flat hand, as in AMASS), False
            if they are relative to the body's mean hand (as from most fitting tools). A key
            `flat_hand_mean` in a file overrides this for that file.
        verbose: show a progress bar.

    Raises:
        FileNotFoundError: no frames, or a mesh or parameter file without its partner.
        ValueError: parameters that are missing, misshapen or not finite; or a mesh that does not
            lie where its parameters say.
    """
    found = find_frames(Path(folder))
    if not found:
        raise FileNotFoundError(f"{folder}: no frames. {_wanted()}")
    frames, _, notices = _load(found, body, betas, flat_hand_mean, verbose)
    notify(notices)
    return frames


def load_folder(
    folder: str | Path,
    body: BodyModel,
    *,
    gender: str | None = None,
    test: Sequence[str] | None = None,
    split_seed: int = 0,
    betas: Float[np.ndarray, " S"] | None = None,
    flat_hand_mean: bool = True,
    verbose: bool = False,
) -> Capture:
    """A capture from a folder as `load_frames` reads it, split into training and test.

    Subfolders `train` and `test` make the split. Without them, sequences (subfolders) are split
    3:1 by `split_seed`, or held out by name; the frames of a single sequence are split in time,
    the last quarter held out.

    Args:
        folder: the folder.
        body: the body the parameters are for.
        gender: takes the place of `gender.txt` in the folder.
        test: names of sequences to hold out.
        split_seed: chooses sequences otherwise.
        betas, flat_hand_mean, verbose: as for `load_frames`.

    Raises:
        FileNotFoundError, ValueError: as for `load_frames`; also for genders that do not match.
    """
    folder = Path(folder)
    found = find_frames(folder)
    if not found:
        raise FileNotFoundError(f"{folder}: no frames. {_wanted()}")
    frames, shape, notices = _load(found, body, betas, flat_hand_mean, verbose)
    held = _held_out(found, folder, test, split_seed)
    gender_file = folder / "gender.txt"
    genders = {str(gender_file): read_gender(gender_file)} if gender_file.is_file() else {}
    subject_gender, more = resolve_gender(genders, body, gender, folder)
    return Capture(
        name=folder.name,
        body=body,
        train=frames[np.flatnonzero(~held)],
        test=frames[np.flatnonzero(held)],
        betas=shape,
        gender=subject_gender,
        fps=float("nan"),
        notices=notify([*notices, *more]),
    )


def find_frames(folder: Path) -> list[tuple[str, Path, Path]]:
    """Sequence, mesh and parameter file of every frame, in order; empty if there are none.

    Raises:
        FileNotFoundError: a mesh or parameter file without its partner.
        ValueError: two meshes or parameter files of one name.
    """
    meshes = _by_name(folder, _MESHES)
    if not meshes:
        return []
    params = _by_name(folder, _PARAMS)
    for name in sorted(meshes.keys() - params.keys()):
        raise FileNotFoundError(
            f"{meshes[name]}: no parameters beside it ({name.name}.npz or .pkl). {_wanted()}"
        )
    beside = {name.parent for name in meshes}
    for name in sorted(params.keys() - meshes.keys()):
        if name.parent in beside:
            raise FileNotFoundError(
                f"{params[name]}: no mesh beside it ({name.name}.ply or .obj). {_wanted()}"
            )
    return [(_sequence(name, folder), meshes[name], params[name]) for name in sorted(meshes)]


def _sequence(name: Path, folder: Path) -> str:
    """Frames in the folder itself are a sequence of its name."""
    inner = name.parent.relative_to(folder).as_posix()
    return folder.resolve().name if inner == "." else inner


def _by_name(folder: Path, suffixes: tuple[str, ...]) -> dict[Path, Path]:
    files: dict[Path, Path] = {}
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.suffix.lower() not in suffixes or hidden or not path.is_file():
            continue
        name = path.with_suffix("")
        if name in files:
            raise ValueError(f"{path} and {files[name].name} are of one frame: remove one.")
        files[name] = path
    return files


def _load(found, body, betas, flat_hand_mean, verbose) -> tuple[Frames, np.ndarray, list[str]]:
    pairs = [(mesh, params) for _, mesh, params in found]
    shape = None if betas is None else np.asarray(betas, np.float64).reshape(-1)
    params, shape, notices = read_params(
        pairs, body, betas=shape, flat_hand_mean=flat_hand_mean, verbose=verbose
    )
    frames = mesh_frames(pairs, [sequence for sequence, _, _ in found], params, body)
    return frames, shape, notices + check_first_frame(frames, body, flat_hand_mean=flat_hand_mean)


def _held_out(
    found: list[tuple[str, Path, Path]], folder: Path, test: Sequence[str] | None, seed: int
) -> np.ndarray:
    """For each frame, whether it is for testing."""
    sequences = [sequence for sequence, _, _ in found]
    tops = {sequence.split("/")[0] for sequence in sequences}
    if tops == {"train", "test"}:
        if test is not None:
            raise ValueError(f"{folder} is split into train and test already; leave out test=.")
        return np.array([sequence.split("/")[0] == "test" for sequence in sequences])
    names = list(dict.fromkeys(sequences))
    if len(names) == 1 and test is None:
        count = len(sequences)
        held = max(round(_TEST_FRACTION * count), 1)
        if held == count:
            raise ValueError(f"{folder}: one frame only; training and test need one each.")
        return np.arange(count) >= count - held
    # All that is not held out is for training, however many sequences there are.
    _, test_names = split_names(names, test=test, seed=seed, source=folder)
    return np.isin(sequences, test_names)


def _wanted() -> str:
    return (
        "A frame is NAME.ply or NAME.obj (metres, y-up) beside NAME.npz or NAME.pkl with SMPL-X "
        "parameters (global_orient, body_pose, transl, ...); subfolders are sequences."
    )
