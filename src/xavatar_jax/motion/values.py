"""Numbers of motion files in their many shapes, to the one that `Motion` holds."""

from __future__ import annotations

import reprlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..body import SMPLX_TREE, BodyModel, pose_groups
from ..files import load_npy
from .format import ReadOptions
from .record import Motion

Side = Literal["left", "right"]
# Rotation matrices in files are rounded to float32 or half, networks' are not quite orthogonal.
_ORTHOGONAL = 1e-2
_NUM_BETAS = 10  # of X-Humans


def numbers(values: Any, name: str, where: str | Path) -> np.ndarray:
    """An array of real numbers, float64.

    Raises:
        ValueError: naming file, field and what it holds instead.
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind in "biuf" or array.size == 0:
            return array.astype(np.float64)
        if array.dtype.kind == "O" and array.size and not isinstance(array.flat[0], str | bytes):
            return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(
        f"{where}: {name} holds {reprlib.repr(values)} ({type(values).__name__}), expected an "
        "array of real numbers."
    )


def rotation_vectors(
    values: Any, joints: int, *, name: str, where: str | Path, count: int | None = None
) -> Float[np.ndarray, "T J 3"]:
    """Rotations of `joints` joints over time as axis-angle, from any shape files use.

    Args:
        values: axis-angle `(T, 3 J)`, `(T, J, 3)`, or of one frame without T; or matrices with
            `(3, 3)` last.
        joints: J.
        name: of the field, for messages.
        where: file, for messages.
        count: T if it is known, which settles what `(3, 3)` is.

    Raises:
        ValueError: another shape, values that are not finite, or matrices that are no rotations.
    """
    array = numbers(values, name, where)
    readings = []
    if array.ndim >= 2 and array.shape[-2:] == (3, 3) and array.size % (9 * joints) == 0:
        readings.append(("matrix", array.size // (9 * joints)))
    if array.shape[-1:] in ((3 * joints,), (3,)) and array.size % (3 * joints) == 0:
        readings.append(("vector", array.size // (3 * joints)))
    readings = [r for r in readings if r[1] > 0 and count in (None, r[1])]
    if not readings:
        frames = "T" if count is None else str(count)
        raise ValueError(
            f"{where}: {name} has shape {array.shape}, expected ({frames}, {3 * joints}) or "
            f"({frames}, {joints}, 3) axis-angle, or ({frames}, {joints}, 3, 3) matrices."
        )
    kind, frames = readings[0]
    array = array.reshape(frames, joints, -1)
    check_finite(array, name, where)
    if kind == "vector":
        check_radians(array, name, where)
        return array
    return _from_matrices(array.reshape(frames, joints, 3, 3), name, where)


def _from_matrices(
    matrices: Float[np.ndarray, "T J 3 3"], name: str, where: str | Path
) -> Float[np.ndarray, "T J 3"]:
    from scipy.spatial.transform import Rotation

    error = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max((-1, -2))
    error = np.where(np.linalg.det(matrices) > 0, error, np.inf)
    if not error.max() < _ORTHOGONAL:
        frame, joint = np.argwhere(~(error < _ORTHOGONAL))[0]
        raise ValueError(
            f"{where}: {name} holds a matrix that is no rotation (frame {frame}, joint {joint})."
        )
    flat = matrices.reshape(-1, 3, 3)
    return Rotation.from_matrix(flat).as_rotvec().reshape(*matrices.shape[:2], 3)


def check_finite(values: np.ndarray, name: str, where: str | Path) -> None:
    """Check that values of every frame, frames first, are finite.

    Raises:
        ValueError: naming the file, the field and the first frame that is not.
    """
    bad = np.logical_not(np.isfinite(values.reshape(len(values), -1)).min(axis=1, initial=True))
    if bad.any():
        raise ValueError(
            f"{where}: {name} is not finite in {int(bad.sum())} of {len(bad)} frames, first in "
            f"frame {int(np.argmax(bad))}: cut or mend those frames."
        )


def check_radians(poses: Float[np.ndarray, "T J 3"], name: str, where: str | Path) -> None:
    """Check that rotations of joints can be radians: no joint turns twice round.

    The first rotation may be that of the body, which does turn round, and is left out.

    Raises:
        ValueError: naming the largest rotation.
    """
    most = float(np.linalg.norm(poses[:, 1:], axis=-1).max(initial=0.0))
    if most > 4 * np.pi:
        raise ValueError(
            f"{where}: {name} holds a rotation of {most:.4g}, which no joint makes in radians: "
            "poses can only be in degrees. Convert them with np.radians, and save them again."
        )


def per_frame(
    values: Any, count: int, *, name: str, where: str | Path, width: int | None = None
) -> Float[np.ndarray, "T n"]:
    """A vector for every frame; one vector stands for all frames.

    Raises:
        ValueError: neither `count` vectors nor one, or of another width.
    """
    array = numbers(values, name, where)
    size = array.shape[-1] if array.ndim else 1
    if array.size == 0 and width is None:
        return np.zeros((count, 0))
    fits = array.size in (size, count * size) and width in (None, size)
    if not fits:
        raise ValueError(
            f"{where}: {name} has shape {array.shape}, expected ({count}, {width or 'n'})."
        )
    array = np.broadcast_to(array.reshape(-1, size), (count, size))
    check_finite(array, name, where)
    return array


def one_shape(betas: Any, notices: list[str]) -> Float[np.ndarray, " S"]:
    """One shape for a person: the mean, with a notice, where the frames' shapes differ."""
    array = np.asarray(betas, np.float64)
    if array.size == 0:
        return np.zeros(0)
    array = array.reshape(-1, array.shape[-1])
    mean = array.mean(axis=0)
    difference = float(np.abs(array - mean).max(initial=0.0))
    if difference <= 1e-5:
        return array[0]
    notices.append(
        f"betas differ between frames by up to {difference:.2g} from their mean; the mean is used"
    )
    return mean


def absolute_hands(
    values: Any,
    side: Side,
    *,
    relative: bool,
    options: ReadOptions,
    name: str,
    where: str | Path,
    count: int,
) -> Float[np.ndarray, "T 15 3"]:
    """Absolute hand pose from a full or principal-component one, mean-relative or not.

    Args:
        values: `(T, 45)`, `(T, 15, 3)`, matrices, or n < 45 principal components `(T, n)`.
        side: of the hand.
        relative: whether the mean hand is to be added.
        options: `body` gives mean hand and components.
        name, where, count: as in `rotation_vectors`.

    Raises:
        ValueError: a body is needed and none was given, or has no such hand or components.
    """
    array = numbers(values, name, where)
    columns = array.size // max(count, 1)
    components = array.size == count * columns and 0 < columns < 45
    if not components:
        pose = rotation_vectors(array, 15, name=name, where=where, count=count)
        if not relative:
            return pose
    body = options.body
    if body is None:
        what = f"holds {columns} principal components" if components else "is relative to the mean"
        raise ValueError(
            f"{where}: {name} {what}{' hand' if not components else ' of a hand'}. Pass "
            "body=xa.load_body(...): its mean hand and components are needed to read the file."
        )
    mean = _hand_mean(body, side)
    if components:
        basis = _components(body, side, columns, name, where)
        pose = (array.reshape(count, columns) @ basis).reshape(count, 15, 3)
        check_finite(pose, name, where)
    return pose + mean if relative else pose


def relative_hands(
    pose: Float[np.ndarray, "T 15 3"], body: BodyModel, side: Side
) -> Float[np.ndarray, "T 45"]:
    """Mean-relative hand pose, as many files hold it, from an absolute one."""
    return (pose - _hand_mean(body, side)).reshape(len(pose), 45)


def doubled_mean_notice(
    pose: Float[np.ndarray, "T 15 3"], body: BodyModel | None, side: Side
) -> str | None:
    """A notice where a hand lies nearer to twice the body's mean hand than to the mean itself.

    That is how a file looks whose hands were absolute already when the mean was added.
    """
    if body is None or len(pose_groups(body.tree)[f"{side}_hand_pose"]) != 15:
        return None
    mean, found = _hand_mean(body, side), pose.mean(axis=0)
    twice, once = np.linalg.norm(found - 2 * mean), np.linalg.norm(found - mean)
    if np.linalg.norm(mean) < 0.1 or twice > once:
        return None
    return (
        f"the {side} hand is nearer to twice the mean hand than to the mean hand: if the file's "
        "hands are absolute, pass flat_hand_mean=True"
    )


def _hand_mean(body: BodyModel, side: str) -> Float[np.ndarray, "15 3"]:
    joints = pose_groups(body.tree)[f"{side}_hand_pose"]
    if len(joints) != 15:
        raise ValueError(f"the body ({body.source.describe()}) has no {side} hand of 15 joints")
    return np.asarray(body.hand_mean, np.float64)[list(joints)]


def _components(
    body: BodyModel, side: str, count: int, name: str, where: str | Path
) -> Float[np.ndarray, "n 45"]:
    components = body.hand_components.get(side)
    if components is None or count > len(components):
        have = "none" if components is None else str(len(components))
        raise ValueError(
            f"{where}: {name} holds {count} principal components; the body "
            f"({body.source.describe()}) has {have}."
        )
    return np.asarray(components[:count], np.float64)


def smplx_poses(motion: Motion) -> tuple[np.ndarray, list[str]]:
    """Poses of SMPL-X's 55 joints, `(T, 55, 3)`, and notices of moving joints left out."""
    poses = np.zeros((len(motion), SMPLX_TREE.num_joints, 3))
    left_out = []
    for name in motion.joint_names:
        if name in SMPLX_TREE.names:
            poses[:, SMPLX_TREE.names.index(name)] = motion.joint(name)
        elif motion.joint(name).any():
            left_out.append(name)
    if not left_out:
        return poses, []
    return poses, [
        f"{motion.source}: {len(left_out)} moving joints are not among SMPL-X's and are left out: "
        f"{', '.join(left_out)}."
    ]


def grouped_poses(
    motion: Motion, body: BodyModel
) -> tuple[dict[str, Float[np.ndarray, "T n"]], list[str]]:
    """Poses by SMPL-X's parameter names, hands relative to the body's mean, and notices."""
    poses, notices = smplx_poses(motion)
    parts = {}
    for name, joints in pose_groups(SMPLX_TREE).items():
        pose = poses[:, list(joints)]
        if name.endswith("hand_pose"):
            side = "left" if name.startswith("left") else "right"
            parts[name] = relative_hands(pose, body, side)
        else:
            parts[name] = pose.reshape(len(motion), -1)
    return parts, notices


def text(value: Any) -> str:
    """A word stored as a string, as bytes, or as an array of either."""
    item = np.asarray(value).reshape(-1)[0]
    return (item.decode() if isinstance(item, bytes) else str(item)).strip()


def listing(keys: Any) -> str:
    """Names of entries, for messages."""
    return ", ".join(sorted(map(str, keys))) or "nothing"


def read_mean_shape(file: Path) -> Float[np.ndarray, " S"]:
    """The shape in a `mean_shape_smplx.npy`: meshes are made with its first ten coefficients."""
    shape = load_npy(file)
    if not isinstance(shape, np.ndarray) or shape.dtype.kind not in "iuf":
        raise ValueError(f"{file}: expected an array of shape coefficients.")
    return shape.reshape(-1)[:_NUM_BETAS].astype(np.float64)


def read_gender(file: Path) -> str:
    """The gender that a `gender.txt` states."""
    return file.read_text(encoding="utf-8").strip().lower()
