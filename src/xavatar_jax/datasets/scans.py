"""Captures of scans: mesh files with a file of SMPL-X parameters for each.

Two layouts are read: a plain folder of meshes with parameters beside them, and the subjects of
X-Humans, which X-Avatar's preparation also writes from GRAB.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..body import BodyModel, BodyParams, hands_to_relative, pose_groups
from ..files.meshes import MESH_SUFFIXES, read_mesh
from ..frames import Frames, nearest_part_labels, posed_vertices
from ..motion.values import read_gender, read_mean_shape
from .capture import Capture, notify, resolve_gender, split_names
from .scan_params import ScanParams, read_scan_params

MAX_MISMATCH_M = 0.10  # median distance of a mesh from the body posed like it
_SAME_VERTICES_M = 0.01
_PARAMS = (".npz", ".pkl")
_TEST_FRACTION = 0.25
_FITTED = "*/[sS][mM][pP][lL][xX]/mesh-f*_smplx"  # registered bodies of X-Humans, without suffix
_SCANS = re.compile(r"mesh(?:es)?[-_ ]?(pkl|ply|obj)", re.IGNORECASE)  # folders of its scans


class Scan(NamedTuple):
    """Files of one frame."""

    sequence: str
    mesh: Path
    params: Path


def load_frames(
    folder: str | Path,
    body: BodyModel,
    *,
    betas: Float[np.ndarray, " S"] | None = None,
    flat_hand_mean: bool = True,
    verbose: bool = False,
) -> Frames:
    """Frames from meshes `NAME.ply|obj|...` beside `NAME.npz|pkl`; subfolders are sequences.

    Parameters have SMPL-X's names: `global_orient`, `body_pose`, `transl`, and optionally
    `left_hand_pose`, `right_hand_pose`, `jaw_pose`, `leye_pose`, `reye_pose`, `betas`,
    `expression`. The shapes `(63,)`, `(1, 63)`, `(21, 3)` and rotation matrices are all accepted.
    Meshes are in metres, in the world of the parameters, y-up; where the parameters hold `scale`
    and `translation`, the mesh is scale * body + translation. Meshes are read on access.

    Args:
        folder: the folder.
        body: the body the parameters are for.
        betas: the person's shape; None for the shape the files agree on, or their mean.
        flat_hand_mean: True if hand poses are absolute (zero is a flat hand, as in AMASS), False
            if they are relative to the body's mean hand (as from most fitting tools). An entry
            `flat_hand_mean` in a file takes precedence for that file.
        verbose: show a progress bar.

    Raises:
        FileNotFoundError: no frames, or a mesh or parameter file without its partner.
        ValueError: parameters that are missing, misshapen or not finite, or a mesh that is not
            where its parameters place the body.
    """
    found, notices = _find_plain(Path(folder).expanduser())
    shape = None if betas is None else np.asarray(betas, np.float64).reshape(-1)
    frames, read = _load(found, body, shape, flat_hand_mean, verbose)
    notify([*notices, *read.notices])
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

    Subfolders `train` and `test` define the split. Without them, sequences (subfolders) are split
    3:1 by `split_seed`, or held out by name; of a single sequence, the last quarter of the frames
    is held out.

    Args:
        folder: the folder.
        body: the body the parameters are for.
        gender: overrides `gender.txt` and the parameter files.
        test: names of sequences to hold out.
        split_seed: seed of the split.
        betas, flat_hand_mean, verbose: as for `load_frames`.

    Raises:
        FileNotFoundError, ValueError: as for `load_frames`; also for genders that do not match.
    """
    folder = Path(folder).expanduser()
    found, notices = _find_plain(folder)
    shape = None if betas is None else np.asarray(betas, np.float64).reshape(-1)
    held = _held_out([scan.sequence for scan in found], folder, test, split_seed)
    return _capture(folder, found, held, body, gender, shape, flat_hand_mean, verbose, notices)


def load_prepared(
    subject_dir: str | Path,
    body: BodyModel,
    *,
    gender: str | None = None,
    test: Sequence[str] | None = None,
    verbose: bool = False,
) -> Capture:
    """Load `SUBJECT/{train,test}/SEQUENCE/SMPLX/mesh-fNNNNNN_smplx.{ply,pkl}`.

    If a sequence has scans beside `SMPLX` (`meshes_pkl/mesh-fNNNNNN.pkl` of X-Humans, or
    `meshes_ply`, `meshes_obj`), the frames are those scans; textures are not read. `gender.txt`
    and `mean_shape_smplx.npy` are in the subject's folder; the mean shape overrides the frames'
    own betas. Meshes are y-up and read on access. Hands are relative to the mean hand in these
    files, so the body's mean hand is added.

    Args:
        subject_dir: the folder.
        body: the body model of the subject's gender.
        gender: overrides `gender.txt`.
        test: must be None, because the folder is split.
        verbose: show a progress bar.

    Raises:
        FileNotFoundError: a mesh or scan without parameters, or parameters without one.
        ValueError: parameters of the wrong shape, a pickle that is more than data, a folder of
            scans under another name, or a gender that does not match the body's.
    """
    folder = Path(subject_dir).expanduser()
    if test is not None:
        raise ValueError(f"{folder} is split into train and test already; leave out test=.")
    parts = [_find_prepared(folder / part) for part in ("train", "test")]
    held = np.repeat([False, True], [len(part) for part in parts])
    shape_file = folder / "mean_shape_smplx.npy"
    shape = read_mean_shape(shape_file) if shape_file.is_file() else None
    return _capture(folder, parts[0] + parts[1], held, body, gender, shape, False, verbose, [])


def find_subject(data_dir: Path) -> Path | None:
    """The subject's folder: `data_dir` or the only subject in it; None if there is none.

    Raises:
        ValueError: there are several subjects.
    """

    def is_subject(folder: Path) -> bool:
        return any(
            next((folder / part).glob(_FITTED + suffix), None) is not None
            for part in ("train", "test")
            for suffix in (".pkl", ".ply")
        )

    if not data_dir.is_dir():
        return None
    if is_subject(data_dir):
        return data_dir
    subjects = [p for p in sorted(data_dir.iterdir()) if p.is_dir() and is_subject(p)]
    if len(subjects) > 1:
        raise ValueError(
            f"{data_dir}: {len(subjects)} subjects ({', '.join(p.name for p in subjects)}); an "
            "avatar is of one person, so choose one of these folders."
        )
    return subjects[0] if subjects else None


def find_frames(folder: Path) -> tuple[list[Scan], list[str]]:
    """Frames of a plain folder, in order, and notices of files that are ignored.

    Raises:
        FileNotFoundError: a mesh or parameter file without its partner.
        ValueError: two meshes or parameter files of one name, or scans that would be ignored.
    """
    meshes = _by_name(folder, MESH_SUFFIXES)
    if not meshes:
        return [], []
    params = _by_name(folder, _PARAMS)
    for name in sorted(meshes.keys() - params.keys()):
        raise FileNotFoundError(
            f"{meshes[name]}: no parameters beside it ({name.name}.npz or .pkl). {_wanted()}"
        )
    beside = {name.parent for name in meshes}
    alone = sorted(params.keys() - meshes.keys())
    for name in alone:
        if name.parent in beside:
            raise FileNotFoundError(
                f"{params[name]}: no mesh beside it ({name.name}.ply or .obj). {_wanted()}"
            )
    notices = _ignored(alone, "parameter files without meshes")
    scans = []
    for name in sorted(meshes):
        inner = name.parent.relative_to(folder).as_posix()
        # Frames in the folder itself form a sequence with the folder's name.
        sequence = folder.resolve().name if inner == "." else inner
        scans.append(Scan(sequence, meshes[name], params[name]))
    return scans, notices


def ignored_meshes(folder: Path) -> list[str]:
    """Notices of mesh files below a folder of motions, except GRAB's `tools` (its templates).

    Raises:
        ValueError: they are scans, by the name of their folder.
    """
    files = [p for p in sorted(folder.rglob("*")) if p.suffix.lower() in MESH_SUFFIXES]
    return _ignored([p for p in files if "tools" not in p.relative_to(folder).parts], "mesh files")


def _ignored(files: Sequence[Path], what: str) -> list[str]:
    folders = dict.fromkeys(file.parent for file in files)
    for folder in folders:
        if re.search("mesh|scan", folder.name.lower()):
            raise ValueError(
                f"{folder}: scans in a layout that is not supported. {_wanted()} X-Humans keeps "
                "scans in meshes_pkl, meshes_ply or meshes_obj beside a folder SMPLX."
            )
    listing = ", ".join(map(str, folders))
    return [f"{listing}: {len(files)} {what} are ignored."] if files else []


def _find_plain(folder: Path) -> tuple[list[Scan], list[str]]:
    found, notices = find_frames(folder)
    if not found:
        raise FileNotFoundError(f"{folder}: no frames. {_wanted()}")
    return found, notices


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


def _wanted() -> str:
    return (
        "A frame is NAME.ply or NAME.obj (metres, y-up) beside NAME.npz or NAME.pkl with SMPL-X "
        "parameters (global_orient, body_pose, transl, ...); subfolders are sequences."
    )


def _held_out(
    sequences: list[str], folder: Path, test: Sequence[str] | None, seed: int
) -> Bool[np.ndarray, " N"]:
    """Whether each frame is for testing."""
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
    # Everything that is not held out is for training, however many sequences there are.
    _, test_names = split_names(names, test=test, seed=seed, source=folder)
    return np.isin(sequences, test_names)


def _find_prepared(folder: Path) -> list[Scan]:
    """Frames of `train` or `test` of a subject, in order."""
    meshes = {p.with_suffix(""): p for p in folder.glob(_FITTED + ".ply")}
    params = {p.with_suffix(""): p for p in folder.glob(_FITTED + ".pkl")}
    for fitted in sorted({name.parent for name in meshes.keys() | params.keys()}):
        scans = _find_scans(fitted)
        if scans is not None:
            meshes = {name: p for name, p in meshes.items() if name.parent != fitted} | scans
    for name in sorted(meshes.keys() ^ params.keys()):
        lacking = ".pkl parameters" if name in meshes else ".ply mesh"
        raise FileNotFoundError(f"{meshes.get(name) or params.get(name)}: no {lacking} beside it.")
    if not meshes:
        raise FileNotFoundError(f"{folder}: no frames; looked for */SMPLX/mesh-f*_smplx.pkl.")
    return [Scan(name.parent.parent.name, meshes[name], params[name]) for name in sorted(meshes)]


def _find_scans(fitted: Path) -> dict[Path, Path] | None:
    """Scans beside a folder of fitted bodies, by the name of the parameters of their frame."""
    beside = [p for p in sorted(fitted.parent.iterdir()) if p.is_dir() and p != fitted]
    known = {m[1].lower(): p for p in beside if (m := _SCANS.fullmatch(p.name))}
    for suffix in ("pkl", "ply", "obj"):
        if suffix in known:
            found = known[suffix].glob(f"mesh-f*.{suffix}")
            return {fitted / f"{p.stem}_smplx": p for p in found}
    for folder in beside:
        held = {p.suffix.lower() for p in folder.iterdir() if not p.name.startswith(".")}
        if held & {".pkl", *MESH_SUFFIXES} and not folder.name.lower().startswith("smpl"):
            raise ValueError(
                f"{folder}: meshes that would be ignored. Scans of a sequence belong in "
                "meshes_pkl, meshes_ply or meshes_obj: rename the folder, or remove it to use the "
                f"fitted bodies in {fitted.name}."
            )
    return None


def _capture(
    folder: Path,
    found: Sequence[Scan],
    held: Bool[np.ndarray, " N"],
    body: BodyModel,
    gender: str | None,
    betas: Float[np.ndarray, " S"] | None,
    flat_hand_mean: bool,
    verbose: bool,
    notices: Sequence[str],
) -> Capture:
    frames, read = _load(found, body, betas, flat_hand_mean, verbose)
    gender_file = folder / "gender.txt"
    genders = {str(gender_file): read_gender(gender_file)} if gender_file.is_file() else {}
    subject_gender, more = resolve_gender(genders or read.genders, body, gender, folder)
    return Capture(
        name=folder.name,
        body=body,
        train=frames[np.flatnonzero(~held)],
        test=frames[np.flatnonzero(held)],
        betas=read.betas,
        gender=subject_gender,
        fps=float("nan"),
        notices=notify([*notices, *more, *read.notices]),
    )


def _load(
    found: Sequence[Scan],
    body: BodyModel,
    betas: Float[np.ndarray, " S"] | None,
    flat_hand_mean: bool,
    verbose: bool,
) -> tuple[Frames, ScanParams]:
    """Frames with meshes that are read on access, once for each, and what their files say."""
    paths = [scan.params for scan in found]
    read = read_scan_params(
        paths, body, betas=betas, flat_hand_mean=flat_hand_mean, verbose=verbose
    )
    names = list(dict.fromkeys(scan.sequence for scan in found))

    def load(i: int) -> tuple[np.ndarray, np.ndarray]:
        vertices, faces = read_mesh(found[i].mesh)
        return (vertices if read.scales[i] == 1 else vertices / read.scales[i]), faces

    frames = Frames(
        read.params,
        load,
        part_labels=lambda i, vertices: part_labels(body, read.params[i], vertices),
        sources=[str(scan.mesh) for scan in found],
        body=body,
        sequence_names=names,
        sequence_index=np.array([names.index(scan.sequence) for scan in found]),
    )
    read.notices.extend(_check_first_frame(frames, body, flat_hand_mean=flat_hand_mean))
    return frames, read


def part_labels(body: BodyModel, params: BodyParams, vertices: np.ndarray) -> np.ndarray:
    """The body's own labels for a mesh with the body's vertices, else those of the nearest."""
    if len(vertices) == body.num_vertices:
        distance = np.linalg.norm(posed_vertices(body, params) - vertices, axis=1)
        if np.median(distance) < _SAME_VERTICES_M:
            return np.asarray(body.part_labels, np.int8)
    return nearest_part_labels(body, params, vertices)


def _check_first_frame(frames: Frames, body: BodyModel, *, flat_hand_mean: bool) -> list[str]:
    """Compare the first mesh with the body in its pose, which reveals wrong units, axes and hands.

    Returns:
        A notice if the hands fit better under the other convention.

    Raises:
        ValueError: mesh and body are more than `MAX_MISMATCH_M` apart.
    """
    from scipy.spatial import cKDTree

    frame = frames[0]
    posed = posed_vertices(body, frame.params)
    tree = cKDTree(frame.vertices)
    distance = tree.query(posed)[0]
    if np.median(distance) > MAX_MISMATCH_M:
        size = np.ptp(frame.vertices, axis=0).max()
        raise ValueError(
            f"{frame.source}: mesh and parameters do not belong together: half of the posed body "
            f"is more than {np.median(distance):.2f} m away from the mesh, which is {size:.3g} m "
            "large. Check units (metres), axes (the mesh must be in the world of the parameters), "
            "transl, and scale and translation where the parameters hold them."
        )
    hands = body.parts.mask("hands")
    if not hands.any() or not np.any(np.asarray(body.hand_mean)):
        return []
    other = tree.query(posed_vertices(body, _other_hands(body, frame.params, flat_hand_mean)))[0]
    mine, theirs = (float(np.mean(d[hands])) for d in (distance, other))
    if theirs < 0.5 * mine and mine - theirs > 1e-3:
        return [
            f"{frame.source}: the hands are {1e3 * mine:.1f} mm from the mesh, and would be "
            f"{1e3 * theirs:.1f} mm from it with flat_hand_mean={not flat_hand_mean}: is the mean "
            "hand added twice, or missing?"
        ]
    return []


def _other_hands(body: BodyModel, params: BodyParams, flat_hand_mean: bool) -> BodyParams:
    pose = params.pose
    for side in ("left", "right"):
        joints = np.array(pose_groups(body.tree)[f"{side}_hand_pose"], dtype=int)
        if not len(joints):
            continue
        hand = pose[joints]
        relative = hands_to_relative(body, hand, side)
        pose = pose.at[joints].set(2 * hand - relative if flat_hand_mean else relative)
    return replace(params, pose=pose)
