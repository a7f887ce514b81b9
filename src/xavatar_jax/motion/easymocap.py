r"""Reading what EasyMocap fits: a JSON document for every frame, with a list of people.

`Rh` and `Th` turn and move the posed body about the origin, $v' = R_h v + T_h$, where SMPL-X turns
it about its pelvis $p$. So the orientation is $R_h R_0$, with $R_0$ the first joint of `poses`
(zero as a rule), and the translation is $T_h + R_h p - p$. Hands are six principal components each
and relative to the mean hand, unless all joints are given.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..body import SMPL_TREE, SMPLH_TREE, SMPLX_TREE, BodyModel
from ..files import load_json
from ..kinematics import KinematicTree
from .editing import fill_gaps
from .format import BODY_ONLY, Format, ReadOptions, Source, choose_person
from .params import numbered
from .record import Motion, rest_pelvis
from .values import Side, absolute_hands, one_shape, per_frame, rotation_vectors

_PATTERN = r"(\d+)\.json"
_FOLDERS = ("smpl", "smplfull", "smplx")
_REQUIRED = {"Rh", "Th", "poses"}
_BODY = 66
_HAND_STARTS: tuple[tuple[Side, int], ...] = (("left", 66), ("right", 72))
# Width of `poses` by model: body (66), hands by components, then jaw and eyes of SMPL-X.
_TREES = {
    72: SMPL_TREE, 69: SMPL_TREE, 78: SMPLH_TREE, 87: SMPLX_TREE, 156: SMPLH_TREE, 165: SMPLX_TREE,
}  # fmt: skip
_MODELS = {SMPL_TREE: "smpl", SMPLH_TREE: "smplh", SMPLX_TREE: "smplx"}


def _people(data: Any) -> list[dict[str, Any]]:
    """The people in a document, or none if it is not of this format."""
    people = data.get("annots", []) if isinstance(data, dict) else data
    if not isinstance(people, list) or not people:
        return []
    fits = all(isinstance(p, dict) and p.keys() >= _REQUIRED for p in people)
    return people if fits else []


def _recognise(source: Source) -> bool:
    if source.kind == "json":
        return bool(_people(source.data))
    # A frame may hold nobody: the first that holds something decides.
    for paths in numbered(source, _PATTERN, _FOLDERS).values():
        data = load_json(paths[0])
        if data:
            return bool(_people(data))
    return False


def _read(source: Source, options: ReadOptions) -> Motion:
    if source.kind == "json":
        documents = {0: (source.path, source.data)}
    else:
        files = numbered(source, _PATTERN, _FOLDERS)
        documents = {n: (paths[0], load_json(paths[0])) for n, paths in files.items()}
    people: dict[int, dict[int, tuple[Path, dict[str, Any]]]] = {}
    for number, (path, data) in documents.items():
        for entry in _people(data):
            person = int(entry.get("id", entry.get("personID", 0)))
            people.setdefault(person, {})[number] = (path, entry)
    counts = {person: len(found) for person, found in people.items()}
    chosen = people[choose_person(counts, options.person, source.path)]
    entries = list(chosen.values())
    notices: list[str] = []
    poses, tree = _poses(entries, options, source.path)
    turn, move, shapes, expression = (
        _stacked(entries, key) for key in ("Rh", "Th", "shapes", "expression")
    )
    betas = one_shape(shapes, notices)
    body, model = _needed_body(options, source.path), _MODELS[tree]
    if model != body.kind:
        notices.append(f"the pelvis of the {body.kind} body stands in for that of {model}")
    pelvis = rest_pelvis(body, betas if model == body.kind else np.zeros(0))
    poses, transl = _about_pelvis(poses, turn, move, pelvis)
    if tree is SMPL_TREE:
        notices.insert(0, BODY_ONLY)
    if options.up is None:
        notices.append("the world is taken as z-up; pass up= if the calibration says otherwise")
    motion = Motion(
        poses=poses,
        transl=transl,
        joint_names=tree.names,
        fps=options.frame_rate(notices),
        betas=betas,
        expression=expression,
        up=options.up or "z",
        source=str(source.path),
        notices=tuple(f"{source.path}: {notice}" for notice in notices),
        model=model,
    )
    return fill_gaps(motion, list(chosen))


def _stacked(entries: list[tuple[Path, dict[str, Any]]], key: str) -> np.ndarray:
    """Rows of all frames; a key that no frame has gives no columns."""
    width = 3 if key in ("Rh", "Th") else None
    rows = [
        per_frame(entry.get(key, []), 1, name=key, where=path, width=width)
        for path, entry in entries
    ]
    if len({row.shape for row in rows}) > 1:
        raise ValueError(f"{entries[0][0].parent}: {key} has not the same size in all frames.")
    return np.concatenate(rows)


def _poses(
    entries: list[tuple[Path, dict[str, Any]]], options: ReadOptions, where: Path
) -> tuple[np.ndarray, KinematicTree]:
    poses = _stacked(entries, "poses")
    count, width = poses.shape
    tree = _TREES.get(width)
    if tree is None:
        raise ValueError(
            f"{where}: poses has {width} numbers a frame; expected one of "
            f"{', '.join(map(str, sorted(_TREES)))}."
        )
    if width == 69:  # newer files leave out the root, which is zero
        poses, width = np.pad(poses, ((0, 0), (3, 0))), 72
    if width in (72, 156, 165):
        whole = rotation_vectors(poses, width // 3, name="poses", where=where, count=count)
        return whole, tree
    hands = [
        absolute_hands(
            poses[:, start : start + 6], side, relative=options.flat_hand_mean is not True,
            options=options, name=f"{side} hand of poses", where=where, count=count,
        )
        for side, start in _HAND_STARTS
    ]  # fmt: skip
    body, head = (p.reshape(count, -1, 3) for p in (poses[:, :_BODY], poses[:, _BODY + 12 :]))
    return np.concatenate([body, head, *hands], axis=1), tree


def _needed_body(options: ReadOptions, where: Path) -> BodyModel:
    if options.body is None:
        raise ValueError(
            f"{where}: Rh and Th turn the body about the origin. Pass body=xa.load_body(...): its "
            "pelvis is needed to turn it about that, as SMPL-X does."
        )
    return options.body


def _about_pelvis(
    poses: np.ndarray, turn: np.ndarray, move: np.ndarray, pelvis: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(turn)
    poses = poses.copy()
    poses[:, 0] = (rotation * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses, move + rotation.apply(np.tile(pelvis, (len(move), 1))) - pelvis


FORMAT = Format(
    name="easymocap",
    title="EasyMocap fits",
    sought="JSON with a list of people that have Rh, Th and poses, or a folder (or its folder "
    "smpl) of such documents named NNNNNN.json",
    recognise=_recognise,
    read=_read,
)
