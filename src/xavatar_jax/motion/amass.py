"""Reading and writing motions in the layout of AMASS ("SMPL-X G" and "SMPL+H G" archives).

The keys are those of the AMASS archives and of the Blender add-ons for SMPL-X: `poses` with all
joints in the order of the model, or the same split into `root_orient`, `pose_body`, `pose_hand`,
`pose_jaw` and `pose_eye`. Hands are absolute there, as in this library.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..body import SMPLH_TREE, SMPLX_TREE
from ..files import atomic_path, load_npz
from .grab import is_grab, read_grab, text
from .record import Motion, UpAxis

_FPS_KEYS = ("mocap_frame_rate", "mocap_framerate")
# Key and number of joints, in the order of the 55 SMPL-X joints.
_SPLIT = {"root_orient": 1, "pose_body": 21, "pose_jaw": 1, "pose_eye": 2, "pose_hand": 30}
_OPTIONAL = ("pose_jaw", "pose_eye", "pose_hand")


def load_motion(path: str | Path, *, fps: float | None = None, up: UpAxis = "z") -> Motion:
    """Read a motion from an archive (`.npz`) of AMASS, SMPL-X or SMPL-H, or of GRAB itself.

    Args:
        path: the archive.
        fps: frames a second; None takes what the file says.
        up: the axis that points up in the file's world. AMASS and GRAB are z-up.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a key is missing (the keys looked for and found are listed), has the wrong
            shape, or holds values that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No motion file at {path}.")
    if path.suffix.lower() != ".npz":
        raise ValueError(f"{path}: motions are read from .npz archives in the AMASS layout.")
    data = load_npz(path)
    if is_grab(data):
        return read_grab(data, path, fps=fps, up=up)
    transl = _array(data, ("trans", "transl"), path)
    poses, names, notices = _poses(data, path)
    gender = text(data["gender"]).lower() if "gender" in data else "unknown"
    betas = np.asarray(data["betas"], np.float64) if "betas" in data else np.zeros(0)
    if "betas" not in data:
        notices.append("no betas: the mean shape is used")
    if betas.ndim == 2:
        if np.abs(betas - betas[:1]).max(initial=0.0) > 1e-5:
            raise ValueError(f"{path}: betas of shape {betas.shape} differ between frames.")
        betas = betas[0]
    expression = next((data[k] for k in ("expression", "expressions") if k in data), None)
    if expression is not None:
        expression = np.asarray(expression, np.float64)
        if expression.ndim == 1:
            expression = np.broadcast_to(expression, (len(poses), len(expression)))
    return Motion(
        poses=poses,
        transl=transl.reshape(-1, 3),
        joint_names=names,
        fps=_fps(data, path) if fps is None else fps,
        betas=betas,
        expression=expression,
        up=up,
        gender=gender,
        source=str(path),
        notices=tuple(f"{path}: {notice}" for notice in notices),
    )


def save_amass(path: str | Path, motion: Motion) -> Path:
    """Write a motion as an AMASS "SMPL-X G" archive that our reader and Blender's add-ons read.

    Every key is written in all its spellings (`mocap_frame_rate` and `mocap_framerate`,
    `expression` and `expressions`), poses whole and split. Nothing in the file is pickled.

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
    poses = np.zeros((len(motion), len(SMPLX_TREE.names), 3))
    for name in motion.joint_names:
        poses[:, SMPLX_TREE.names.index(name)] = motion.joint(name)
    arrays: dict[str, Any] = {
        "gender": np.array(motion.gender),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(float(motion.fps)),
        "mocap_framerate": np.array(float(motion.fps)),
        "mocap_time_length": np.array(len(motion) / motion.fps),
        "trans": motion.transl,
        "poses": poses.reshape(len(motion), -1),
        "betas": motion.betas,
        "num_betas": np.array(len(motion.betas)),
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


def _poses(data: dict[str, Any], path: Path) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    if "poses" in data:
        poses = np.asarray(data["poses"], np.float64)
        poses = poses.reshape(len(poses), -1) if poses.ndim else poses
        by_width = {3 * len(names): names for names in (SMPLX_TREE.names, SMPLH_TREE.names)}
        names = by_width.get(poses.shape[-1] if poses.ndim == 2 else -1)
        if names is None:
            raise ValueError(
                f"{path}: poses has shape {np.shape(data['poses'])}; expected (T, 165) for "
                "SMPL-X or (T, 156) for SMPL-H, axis-angle."
            )
        return poses.reshape(len(poses), len(names), 3), names, []
    return _split_poses(data, path)


def _split_poses(data: dict[str, Any], path: Path) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    missing = [key for key in _SPLIT if key not in data and key not in _OPTIONAL]
    if missing:
        raise ValueError(
            f"{path}: no {' and no '.join(missing)}. Looked for poses, or for "
            f"{', '.join(_SPLIT)}; found {_keys(data)}."
        )
    count = len(np.asarray(data["root_orient"]))
    parts, notices = [], []
    for key, joints in _SPLIT.items():
        if key not in data:
            notices.append(f"no {key}: zero is used")
            parts.append(np.zeros((count, joints, 3)))
            continue
        part = np.asarray(data[key], np.float64)
        if part.size != count * joints * 3 or len(part) != count:
            raise ValueError(
                f"{path}: {key} has shape {part.shape}, expected ({count}, {3 * joints}) "
                "axis-angle (principal components of hands are not read here)."
            )
        parts.append(part.reshape(count, joints, 3))
    return np.concatenate(parts, axis=1), SMPLX_TREE.names, notices


def _array(data: dict[str, Any], names: tuple[str, ...], path: Path) -> np.ndarray:
    for name in names:
        if name in data:
            return np.asarray(data[name], np.float64)
    raise ValueError(f"{path}: no {' or '.join(names)}; found {_keys(data)}.")


def _fps(data: dict[str, Any], path: Path) -> float:
    for key in _FPS_KEYS:
        if key in data:
            return float(np.asarray(data[key]).reshape(-1)[0])
    raise ValueError(
        f"{path}: no frame rate ({' or '.join(_FPS_KEYS)}); found {_keys(data)}. "
        "Give fps= if you know it."
    )


def _keys(data: dict[str, Any]) -> str:
    return ", ".join(sorted(data)) or "nothing"
