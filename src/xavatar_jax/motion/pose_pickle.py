"""Writing poses as pickles of SMPL-X parameters: for Blender's add-on, or a folder of frames."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path

import numpy as np

from ..body import BodyModel
from ..files import atomic_folder, atomic_path
from .record import Motion, MotionNotice, shape_for
from .values import grouped_poses

# NumPy 2 names its functions by a new module, which the NumPy 1 of many Blenders has not; both
# know the old name. Protocol 2 writes names without their length, so that they can be replaced.
_NEW, _OLD = b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n"


def save_poses(path: str | Path, motion: Motion, body: BodyModel) -> Path:
    """Write frames as pickles of SMPL-X parameters, as "Load pose" of Blender's add-on takes them.

    A path that ends in `.pkl` is one file, for a motion of one frame (`motion[10:11]`). Any other
    is a folder of `mesh-fNNNNN_smplx.pkl`, the layout of X-Humans. Every value has the shape
    `(1, n)`, and hands are relative to the mean hand, as these readers want it.

    Args:
        path: file or folder to write, whole or not at all.
        motion: a y-up motion.
        body: gives the mean hand.

    Raises:
        ValueError: the motion is not y-up, or has several frames for one file.
        FileExistsError: the folder exists.
    """
    target = Path(path)
    if motion.up != "y":
        raise ValueError(
            f"{motion.source}: pose pickles are y-up and this motion is {motion.up}-up; save "
            "motion.to_y_up(body)."
        )
    one = target.suffix.lower() == ".pkl"
    if one and len(motion) != 1:
        raise ValueError(
            f"{motion.source}: {len(motion)} frames, and {target.name} holds one. Cut the motion, "
            "for example motion[10:11], or give a folder."
        )
    if not one and target.exists():
        raise FileExistsError(f"{target} exists; poses are written to a new folder.")
    frames, notices = _frames(motion, body)
    for notice in notices:
        warnings.warn(notice, MotionNotice, stacklevel=2)
    if one:
        with atomic_path(target) as temporary:
            temporary.write_bytes(_dump(frames[0]))
        return target
    with atomic_folder(target) as folder:
        for number, frame in enumerate(frames):
            (folder / f"mesh-f{number:05d}_smplx.pkl").write_bytes(_dump(frame))
        if motion.gender != "unknown":
            (folder / "gender.txt").write_text(f"{motion.gender}\n", encoding="utf-8")
    return target


def _frames(motion: Motion, body: BodyModel) -> tuple[list[dict[str, np.ndarray]], list[str]]:
    poses, notices = grouped_poses(motion, body)
    notices.append(f"{motion.source}: pose pickles hold no frame rate ({motion.fps:g} a second).")
    parts = {"transl": motion.transl, "expression": np.asarray(motion.expression), **poses}
    betas, notice = shape_for(motion, body)
    notices += [] if notice is None else [notice]
    parts["betas"] = np.broadcast_to(betas, (len(motion), len(betas)))
    frames = [
        {name: np.ascontiguousarray(values[[k]]) for name, values in parts.items()}
        for k in range(len(motion))
    ]
    return frames, notices


def _dump(frame: dict[str, np.ndarray]) -> bytes:
    return pickle.dumps(frame, protocol=2).replace(_NEW, _OLD)
