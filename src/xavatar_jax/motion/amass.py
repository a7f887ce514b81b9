"""Reading and writing motions in the layout of AMASS ("SMPL-X G" and "SMPL+H G" archives).

The keys are those of the AMASS archives and of the Blender add-ons for SMPL-X: `poses` with all
joints in the order of the model, or the same split into `root_orient`, `pose_body`, `pose_hand`,
`pose_jaw` and `pose_eye`. Hands are absolute there, as in this library.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..body import SMPL_TREE, SMPLH_TREE, SMPLX_TREE
from ..files import atomic_path
from .content import joint_count
from .format import BODY_ONLY, DEFAULT_FPS, Format, ReadOptions, Source
from .record import Motion, MotionNotice
from .values import (
    Side,
    absolute_hands,
    check_radians,
    listing,
    one_shape,
    rotation_vectors,
    smplx_poses,
    text,
)

_FPS_KEYS = ("mocap_frame_rate", "mocap_framerate", "fps")
# Key and number of joints, in the order of the 55 SMPL-X joints.
_SPLIT = {"root_orient": 1, "pose_body": 21, "pose_jaw": 1, "pose_eye": 2, "pose_hand": 30}
_OPTIONAL = ("pose_jaw", "pose_eye", "pose_hand")
_KEYS = {"trans", "poses", "dmpls", "mocap_time_length", *_FPS_KEYS, *_SPLIT}
_MODELS = {SMPLX_TREE.names: "smplx", SMPLH_TREE.names: "smplh", SMPL_TREE.names: "smpl"}
_GENDERS = ("neutral", "male", "female")


def _recognise(source: Source) -> bool:
    # One key alone may stand in any archive; names of SMPL-X's parameters are another format.
    others = {"global_orient", "body", "smplx_params", "smpl_params"}
    known = source.keys & _KEYS
    if len(known) < 2 or source.keys & others:
        return False
    # AMASS has no SMPL; its layout is used with it where a rate is given.
    smpl = "poses" in known and joint_count(source.data["poses"]) == SMPL_TREE.num_joints
    return not smpl or bool(known & set(_FPS_KEYS))


def _read(source: Source, options: ReadOptions) -> Motion:
    data, path = source.data, source.path
    _refuse_other_models(data, path)
    transl = _array(data, ("trans", "transl"), path)
    notices: list[str] = []
    poses, names = _poses(data, path, options, notices)
    check_radians(poses, "poses", path)
    if names == SMPL_TREE.names and not (options.body and options.body.kind == "smpl"):
        notices.append(BODY_ONLY)
    betas = np.zeros(0)
    if "betas" not in data:
        notices.append("no betas: the mean shape is used")
    else:
        betas = _betas(data["betas"], path)
    expression = next((data[k] for k in ("expression", "expressions") if k in data), None)
    if expression is not None:
        expression = np.asarray(expression, np.float64)
        if expression.ndim == 1:
            expression = np.broadcast_to(expression, (len(poses), len(expression)))
    return Motion(
        poses=poses,
        transl=transl.reshape(-1, 3),
        joint_names=names,
        fps=_fps(data, path) if options.fps is None else options.fps,
        betas=betas,
        expression=expression,
        up=options.up or "z",
        gender=text(data["gender"]).lower() if "gender" in data else "unknown",
        source=str(path),
        notices=tuple(f"{path}: {notice}" for notice in notices),
        model=_MODELS[names],
    )


def save_amass(path: str | Path, motion: Motion) -> Path:
    """Write a motion as an AMASS "SMPL-X G" archive that our reader and Blender's add-ons read.

    Every key is written in all its spellings (`mocap_frame_rate`, `mocap_framerate` and `fps`,
    `expression` and `expressions`), poses whole and split. Nothing in the file is pickled. What
    is lost, and what the add-ons would not take, is said in a `MotionNotice`.

    Args:
        path: the `.npz` to write; replaced as a whole, or not at all.
        motion: a z-up motion, as the layout wants it.

    Returns:
        The path written.

    Raises:
        ValueError: the motion is not z-up, or has joints that SMPL-X has not.
    """
    if motion.up != "z":
        raise ValueError(
            f"{motion.source}: AMASS archives are z-up and this motion is {motion.up}-up; "
            "save motion.to_z_up(body)."
        )
    foreign = [name for name in motion.joint_names if name not in SMPLX_TREE.names]
    if foreign:
        raise ValueError(
            f"{motion.source}: AMASS archives hold SMPL-X joints; not among them: "
            f"{', '.join(foreign)}."
        )
    poses, _ = smplx_poses(motion)  # leaves nothing out: no joint is foreign
    foreign_shape = motion.model not in ("smplx", "unknown") and motion.betas.any()
    betas = np.zeros(10) if foreign_shape else motion.betas
    gender = motion.gender if motion.gender in _GENDERS else "neutral"
    for notice in _writing_notices(motion, gender, bool(foreign_shape)):
        warnings.warn(f"{motion.source}: {notice}.", MotionNotice, stacklevel=2)
    arrays: dict[str, Any] = {
        "gender": np.array(gender),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(float(motion.fps)),
        "mocap_framerate": np.array(float(motion.fps)),
        "fps": np.array(float(motion.fps)),
        "mocap_time_length": np.array(len(motion) / motion.fps),
        "trans": motion.transl,
        "poses": poses.reshape(len(motion), -1),
        "betas": betas,
        "num_betas": np.array(len(betas)),
        "expression": motion.expression,
        "expressions": motion.expression,
    }
    start = 0
    for key, joints in _SPLIT.items():
        arrays[key] = poses[:, start : start + joints].reshape(len(motion), -1)
        start += joints
    target = Path(path)
    with atomic_path(target) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)
    return target


def _writing_notices(motion: Motion, gender: str, foreign_shape: bool) -> list[str]:
    notices = []
    if gender != motion.gender:
        notices.append(
            f"gender {motion.gender!r} is written as {gender}: Blender's add-ons need one"
        )
    if foreign_shape:
        notices.append(f"betas are of {motion.model} and are left out of an archive for SMPL-X")
    if motion.template is not None:
        notices.append(f"the template {motion.template} is not in the archive")
    if int(motion.fps) < DEFAULT_FPS or motion.fps != int(motion.fps):
        notices.append(
            f"{motion.fps:g} frames per second: Blender's add-ons cut the rate to a whole number "
            f"and refuse one below their target, {DEFAULT_FPS:g} unless set; use motion.resample"
        )
    return notices


def _refuse_other_models(data: dict[str, Any], path: Path) -> None:
    if "surface_model_type" not in data:
        return
    model = text(data["surface_model_type"]).lower()
    if not model.startswith(("smpl", "unknown")):
        raise ValueError(
            f"{path}: surface_model_type is {model!r}; archives of SMPL-X, SMPL-H and SMPL "
            "are read."
        )


def _betas(values: Any, path: Path) -> np.ndarray:
    betas = np.asarray(values, np.float64)
    if betas.ndim < 2:
        return betas.reshape(-1)
    notices: list[str] = []
    shape = one_shape(betas, notices)
    if notices:
        raise ValueError(f"{path}: betas of shape {betas.shape} differ between frames.")
    return shape


def _poses(
    data: dict[str, Any], path: Path, options: ReadOptions, notices: list[str]
) -> tuple[np.ndarray, tuple[str, ...]]:
    if "poses" not in data:
        return _split_poses(data, path, options, notices)
    poses = np.asarray(data["poses"], np.float64)
    poses = poses.reshape(len(poses), -1) if poses.ndim else poses
    by_width = {3 * len(names): names for names in _MODELS}
    names = by_width.get(poses.shape[-1] if poses.ndim == 2 else -1)
    if names is None:
        raise ValueError(
            f"{path}: poses has shape {np.shape(data['poses'])}; expected (T, 165) for "
            "SMPL-X, (T, 156) for SMPL-H or (T, 72) for SMPL, axis-angle."
        )
    return poses.reshape(len(poses), len(names), 3), names


def _split_poses(
    data: dict[str, Any], path: Path, options: ReadOptions, notices: list[str]
) -> tuple[np.ndarray, tuple[str, ...]]:
    missing = [key for key in _SPLIT if key not in data and key not in _OPTIONAL]
    if missing:
        raise ValueError(
            f"{path}: no {' and no '.join(missing)}. Looked for poses, or for "
            f"{', '.join(_SPLIT)}; found {listing(data)}."
        )
    body = rotation_vectors(data["pose_body"], 21, name="pose_body", where=path)
    count, parts = len(body), []
    for key, joints in _SPLIT.items():
        if key not in data:
            notices.append(f"no {key}: zero is used")
            parts.append(np.zeros((count, joints, 3)))
        elif key == "pose_hand":
            parts.append(_hands(data[key], path, options, count))
        else:
            parts.append(rotation_vectors(data[key], joints, name=key, where=path, count=count))
    return np.concatenate(parts, axis=1), SMPLX_TREE.names


def _hands(values: Any, path: Path, options: ReadOptions, count: int) -> np.ndarray:
    """Both hands, `(T, 30, 3)`: absolute, or principal components if the caller says of what."""
    array = np.asarray(values, np.float64)
    columns = array.size // max(count, 1)
    if array.ndim != 2 or columns >= 90 or len(array) != count:
        return rotation_vectors(array, 30, name="pose_hand", where=path, count=count)
    if options.flat_hand_mean is None:
        raise ValueError(
            f"{path}: pose_hand has shape {array.shape}: principal components. Pass "
            "flat_hand_mean=True if they start from the flat hand, False if from the mean hand."
        )
    halves: dict[Side, np.ndarray] = {
        "left": array[:, : columns // 2],
        "right": array[:, columns // 2 :],
    }
    hands = [
        absolute_hands(
            values, side, relative=not options.flat_hand_mean, options=options,
            name=f"{side} half of pose_hand", where=path, count=count,
        )
        for side, values in halves.items()
    ]  # fmt: skip
    return np.concatenate(hands, axis=1)


def _array(data: dict[str, Any], names: tuple[str, ...], path: Path) -> np.ndarray:
    for name in names:
        if name in data:
            return np.asarray(data[name], np.float64)
    raise ValueError(f"{path}: no {' or '.join(names)}; found {listing(data)}.")


def _fps(data: dict[str, Any], path: Path) -> float:
    for key in _FPS_KEYS:
        if key in data:
            return float(np.asarray(data[key]).reshape(-1)[0])
    raise ValueError(
        f"{path}: no frame rate ({' or '.join(_FPS_KEYS)}); found {listing(data)}. "
        "Give fps= if you know it."
    )


FORMAT = Format(
    name="amass",
    title="AMASS, SMPL-X or SMPL-H",
    sought="an .npz with trans, and poses (T, 165 or 156) or root_orient and pose_body",
    recognise=_recognise,
    read=_read,
)
