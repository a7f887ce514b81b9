"""Body parameters of scans, as fitting tools write them: one file beside each mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..body import BodyModel, BodyParams, hands_to_absolute, pose_groups
from ..motion.content import ALIASES
from ..motion.params import read_named
from ..motion.values import rotation_vectors, text
from .capture import one_shape

_REQUIRED = ("global_orient", "body_pose", "transl")
_HANDS = {"left_hand_pose": "left", "right_hand_pose": "right"}
_FULL_POSES = ("pose", "poses", "fullpose")
# Entries that do not change the result.
_METADATA = {"model_type", "use_pca", "num_pca_comps", "num_betas", "num_expression_coeffs"}
_READ = {"flat_hand_mean", "gender", "scale", "translation"}.union(
    _FULL_POSES, _METADATA, *ALIASES.values()
)


@dataclass(frozen=True, eq=False)
class ScanParams:
    """Parameters of N scans.

    Attributes:
        params: batched over the scans; hands are absolute.
        betas: the shape of the person.
        scales: size of each mesh relative to its body; the mesh in metres is the file's divided
            by it.
        genders: gender by file, for the files that state one.
        notices: what was assumed, changed or ignored.
    """

    params: BodyParams
    betas: Float[np.ndarray, " S"]
    scales: Float[np.ndarray, " N"]
    genders: dict[str, str]
    notices: list[str]


def read_scan_params(
    paths: Sequence[Path],
    body: BodyModel,
    *,
    betas: Float[np.ndarray, " S"] | None,
    flat_hand_mean: bool,
    verbose: bool,
) -> ScanParams:
    """Read one parameter file for each scan.

    `scale` and `translation` place the mesh: vertices = scale * body + translation. The mesh is
    divided by the scale and the translation is added to `transl`.

    Args:
        paths: a file for each scan.
        body: the body the parameters are for.
        betas: the person's shape; None for the shape the files agree on, or their mean.
        flat_hand_mean: whether hands are absolute in files that do not say.
        verbose: show a progress bar.

    Raises:
        ValueError: a parameter is missing, misshapen or not finite, or files that hold different
            parameters; names the file.
    """
    from tqdm.auto import tqdm

    bar = tqdm(paths, desc="reading parameters", unit="file", disable=None if verbose else True)
    frames, ignored, genders = [], {}, {}
    for path in bar:
        data = {name: value for name, value in read_named(path).items() if value is not None}
        ignored |= dict.fromkeys(map(str, data.keys() - _READ))
        if "gender" in data:
            genders[str(path)] = text(data["gender"]).lower()
        frames.append(_read_frame(data, body, path))
    where, notices = paths[0].parent, []
    if betas is None:
        given = {str(p): f["betas"] for p, f in zip(paths, frames, strict=True) if "betas" in f}
        betas, notice = one_shape(given) if given else (np.zeros(0), None)
        if not given:
            notice = f"{where}: no betas in the parameter files; the mean shape is used."
        notices += [notice] if notice else []
    expression = max((f["expression"].size for f in frames if "expression" in f), default=0)
    for name, most, known in (
        ("betas", len(betas), body.num_betas),
        ("expression", expression, body.num_expression),
    ):
        if most > known:
            notices.append(f"{where}: {most} {name} given, the body has {known}.")
    if ignored:
        notices.append(
            f"{where}: ignored entries of the parameter files: {', '.join(sorted(ignored))}."
        )
    scales = np.array([frame["scale"] for frame in frames])
    if (scales != 1).any():
        notices.append(
            f"{where}: the parameter files give scales of {scales.min():.4g} to "
            f"{scales.max():.4g}; the meshes are divided by them."
        )
    params = _stack(frames, paths, body, betas, flat_hand_mean=flat_hand_mean)
    return ScanParams(params, betas, scales, genders, notices)


def _read_frame(data: dict[str, Any], body: BodyModel, path: Path) -> dict[str, np.ndarray]:
    """One frame's parameters by SMPL-X's names, each a vector; hands stay as in the file."""
    data = _split_full_pose(data, body, path)
    scale = _numbers(data, "scale", path, 1) if "scale" in data else np.ones(1)
    if scale[0] <= 0:
        raise ValueError(f"{path}: scale is {scale[0]:g}, expected a number above zero.")
    shift = _numbers(data, "translation", path, 3) if "translation" in data else None
    groups = pose_groups(body.tree)
    params: dict[str, np.ndarray] = {"scale": scale[0]}
    for name, aliases in ALIASES.items():
        key = next((key for key in aliases if key in data and key != "translation"), None)
        joints = len(groups.get(name, ()))
        if name in groups and joints == 0:
            continue  # a body without this joint
        if key is not None:
            size = 3 if name == "transl" else 3 * joints
            params[name] = _vector(_numbers(data, key, path), size, name, path)
        elif name in _REQUIRED and not (name == "transl" and shift is not None):
            raise ValueError(f"{path}: no {' or '.join(aliases)}; found {', '.join(sorted(data))}.")
    if shift is not None:
        params["transl"] = params.get("transl", np.zeros(3)) + shift / scale
    if "flat_hand_mean" in data:
        params["flat_hand_mean"] = np.asarray(bool(np.asarray(data["flat_hand_mean"])))
    return params


def _numbers(data: dict[str, Any], key: str, path: Path, size: int | None = None) -> np.ndarray:
    try:
        values = np.asarray(data[key])
    except ValueError as error:  # nested lists of different lengths
        raise ValueError(f"{path}: {key} is not an array of numbers: {error}.") from None
    if values.dtype.kind not in "buif":
        raise ValueError(f"{path}: {key} has the type {values.dtype}, expected real numbers.")
    if not np.isfinite(values).all():
        raise ValueError(f"{path}: {key} is not finite.")
    if size is None:
        return values.astype(np.float64)
    if values.size != size:
        raise ValueError(f"{path}: {key} has shape {values.shape}, expected {size} numbers.")
    return values.astype(np.float64).reshape(-1)


def _split_full_pose(data: dict[str, Any], body: BodyModel, path: Path) -> dict[str, Any]:
    key = next((k for k in _FULL_POSES if k in data), None)
    if key is None:
        return data
    pose = _numbers(data, key, path)
    if pose.size != 3 * body.num_joints:
        raise ValueError(
            f"{path}: {key} has shape {pose.shape}, expected ({3 * body.num_joints},): all "
            f"{body.num_joints} joints of one frame, axis-angle."
        )
    pose = pose.reshape(-1, 3)
    groups = {name: pose[list(joints)] for name, joints in pose_groups(body.tree).items()}
    return {**groups, **{k: v for k, v in data.items() if k != key}}


def _vector(values: np.ndarray, size: int, name: str, path: Path) -> np.ndarray:
    if name in ("betas", "expression") or values.size == size:
        return values.reshape(-1)
    if name != "transl" and values.size == 3 * size and values.shape[-2:] == (3, 3):
        return rotation_vectors(values, size // 3, name=name, where=path, count=1).reshape(-1)
    if name in _HANDS and 0 < values.size < size:
        return values.reshape(-1)  # principal components
    raise ValueError(
        f"{path}: {name} has shape {values.shape}, expected ({size},), (1, {size}) or "
        f"({size // 3}, 3) of one frame."
    )


def _stack(
    frames: Sequence[dict[str, np.ndarray]],
    paths: Sequence[Path],
    body: BodyModel,
    betas: np.ndarray,
    *,
    flat_hand_mean: bool,
) -> BodyParams:
    """Batched parameters from those of single frames, with absolute hands."""
    absolute = np.array([bool(f.get("flat_hand_mean", flat_hand_mean)) for f in frames])
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
            mean = np.asarray(body.hand_mean)[list(pose_groups(body.tree)[name])]
            with_mean = np.asarray(hands_to_absolute(body, values, _HANDS[name]))  # type: ignore[arg-type]
            values = np.where(absolute[:, None, None], with_mean - mean, with_mean)
        if name == "expression":
            values = values[:, : body.num_expression]
        arrays[name] = values
    betas = betas[: body.num_betas]
    return BodyParams.create(
        body, betas=np.broadcast_to(betas, (len(frames), len(betas))), **arrays
    )
