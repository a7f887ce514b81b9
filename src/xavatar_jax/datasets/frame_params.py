"""Body parameters of single frames, as fitting tools write them beside each mesh."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..body import BodyModel, BodyParams, hands_to_absolute, pose_groups
from ..motion.params import ALIASES, read_named
from ..motion.values import rotation_vectors

_REQUIRED = ("global_orient", "body_pose", "transl")
_HANDS = {"left_hand_pose": "left", "right_hand_pose": "right"}


def read_frame_params(path: Path, body: BodyModel) -> dict[str, np.ndarray]:
    """Read one frame's parameters, by SMPL-X's names, each flattened to a vector.

    Shapes `(63,)`, `(1, 63)` and `(21, 3)` all mean the same; rotation matrices `(21, 3, 3)`
    become axis-angle; `poses` may hold all joints. Hands stay as they are in the file.

    Raises:
        ValueError: a parameter is missing, has the wrong size, or is not finite; the message
            names the file, what was looked for, and what was found.
    """
    data = _split_full_pose(read_named(path), body, path)
    groups = pose_groups(body.tree)
    params = {}
    for name, aliases in ALIASES.items():
        key = next((alias for alias in aliases if alias in data), None)
        joints = len(groups.get(name, ()))
        if name in groups and joints == 0:
            continue  # a body without this joint
        if key is None:
            if name in _REQUIRED:
                raise ValueError(
                    f"{path}: no {' or '.join(aliases)}; found {', '.join(sorted(data))}."
                )
            continue
        values = np.asarray(data[key], np.float64)
        if not np.isfinite(values).all():
            raise ValueError(f"{path}: {key} is not finite.")
        params[name] = _vector(values, 3 if name == "transl" else 3 * joints, name, path)
    if "flat_hand_mean" in data:
        params["flat_hand_mean"] = np.asarray(bool(np.asarray(data["flat_hand_mean"])))
    return params


def stack_params(
    frames: Sequence[dict[str, np.ndarray]],
    paths: Sequence[Path],
    body: BodyModel,
    betas: np.ndarray,
    *,
    flat_hand_mean: bool,
) -> BodyParams:
    """Batched parameters from those of single frames, hands made absolute.

    Args:
        frames: what `read_frame_params` gave.
        paths: the file of each, for messages.
        body: gives the mean hands.
        betas: the one shape of the subject.
        flat_hand_mean: whether hands are absolute in files that do not say.

    Raises:
        ValueError: files that do not agree on what they hold.
    """
    absolute = [bool(f.get("flat_hand_mean", flat_hand_mean)) for f in frames]
    arrays: dict[str, Any] = {}
    for name in ALIASES:
        if name == "betas" or not any(name in f for f in frames):
            continue
        sizes = [f[name].size if name in f else None for f in frames]
        if len(set(sizes)) > 1:
            odd = next(i for i, size in enumerate(sizes) if size != sizes[0])
            raise ValueError(
                f"{paths[odd]}: {name} has {sizes[odd] or 'no'} numbers, but {sizes[0] or 'no'} "
                f"in {paths[0]}; all frames must hold the same."
            )
        values = np.stack([f[name] for f in frames])
        if name in _HANDS:
            values = _absolute_hands(body, values, np.array(absolute), name)
        if name == "expression":
            values = values[:, : body.num_expression]
        arrays[name] = values
    betas = betas[: body.num_betas]
    return BodyParams.create(
        body, betas=np.broadcast_to(betas, (len(frames), len(betas))), **arrays
    )


def _absolute_hands(
    body: BodyModel, values: np.ndarray, absolute: np.ndarray, name: str
) -> np.ndarray:
    with_mean = np.asarray(hands_to_absolute(body, values, _HANDS[name]))  # type: ignore[arg-type]
    mean = np.asarray(body.hand_mean)[list(pose_groups(body.tree)[name])]
    return np.where(absolute[:, None, None], with_mean - mean, with_mean)


def _split_full_pose(data: dict[str, Any], body: BodyModel, path: Path) -> dict[str, Any]:
    key = next((k for k in ("pose", "poses", "fullpose") if k in data), None)
    if key is None:
        return data
    pose = np.asarray(data[key], np.float64)
    if pose.size != 3 * body.num_joints:
        raise ValueError(
            f"{path}: {key} has shape {pose.shape}, expected ({3 * body.num_joints},): all "
            f"{body.num_joints} joints of one frame, axis-angle."
        )
    pose = pose.reshape(-1, 3)
    groups = {name: pose[list(joints)] for name, joints in pose_groups(body.tree).items()}
    return {**groups, **{k: v for k, v in data.items() if k != key}}


def _vector(values: np.ndarray, size: int, name: str, path: Path) -> np.ndarray:
    if name in ("betas", "expression"):
        return values.reshape(-1)
    if values.size == size:
        return values.reshape(-1)
    if name != "transl" and values.size == 3 * size and values.shape[-2:] == (3, 3):
        return rotation_vectors(values, size // 3, name=name, where=path, count=1).reshape(-1)
    if name in _HANDS and 0 < values.size < size:
        return values.reshape(-1)  # principal components
    raise ValueError(
        f"{path}: {name} has shape {values.shape}, expected ({size},), (1, {size}) or "
        f"({size // 3}, 3) of one frame."
    )
