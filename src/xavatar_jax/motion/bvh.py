r"""Motions in BVH files: reading with a joint map, and writing.

BVH holds a skeleton, rotations and the place of its root; neither shape, expression nor gender. A
joint's rotation counts from the skeleton's own rest pose $s$, a body's from the T-pose. With $A_j$
the turn that takes a limb of the T-pose to its direction in the file's rest pose, and $G_j$ the
rotation of the file's joint in the world, the body's joint has the rotation $G_j A_j$ in the world.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..body import BodyModel, rest_joints
from ..files import atomic_path
from .bvh_joints import NEEDED, match_joints
from .bvh_text import Skeleton, local_places, local_rotations, parse, write
from .convert import MotionNotice, shape_for
from .format import Format, ReadOptions, Source
from .record import Motion
from .rotate import pelvis_of, to_up
from .values import check_finite

# Limbs and the joint at their far end: rest poses differ in these (A-pose against T-pose).
_LIMBS = {
    f"{side}_{near}": f"{side}_{far}"
    for side in ("left", "right")
    for near, far in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
}
# A skeleton with SMPL-X's names is SMPL-X at rest in some shape, in metres, if no more than this
# is between it and the body.
_OWN_SCALE, _OWN_ANGLE = 0.25, np.radians(10.0)


def _read(source: Source, options: ReadOptions) -> Motion:
    where = str(source.path)
    up, body = options.turned(where), options.body
    if body is None:
        raise ValueError(
            f"{where}: BVH holds the place of a pelvis and a rest pose of its own. Pass "
            "body=xa.load_body(...), the body that is to move."
        )
    skeleton, values, interval = parse(source.data, where)
    if len(values) == 0:
        raise ValueError(f"{where}: the motion has no frames.")
    check_finite(values, "the motion", where)
    if options.fps is None and not interval > 0:
        raise ValueError(f"{where}: Frame Time: {interval}; it must be positive. Give fps=.")
    title, joints = match_joints(skeleton.names, options.joint_map, where)
    lacking = [name for name in NEEDED if name not in body.tree.names]
    if lacking:
        raise ValueError(
            f"{where}: the body ({body.source.describe()}) has no {', '.join(lacking)}; BVH is "
            "read for bodies with the joint names of SMPL-X."
        )
    notices = _unused(skeleton, joints, title, body)
    rest, body_rest = _rest_places(skeleton), _body_rest(body, np.zeros(0))
    turned, places, stretched = _world(skeleton, values)
    if stretched:
        notices.append("joints below the root move against their parents; that is left out")
    frame = _axes(rest, joints, where)
    if not np.array_equal(frame, np.eye(3)):
        notices.append("the skeleton at rest is not y-up facing +z; it was turned")
        turned, places, rest = frame @ turned @ frame.T, places @ frame.T, rest @ frame.T
    corrections, angle = _corrections(rest, joints, body_rest)
    if title == "smplx" and angle < _OWN_ANGLE:
        corrections = {}
    elif angle > np.radians(1):
        notices.append(
            f"limbs at rest point up to {np.degrees(angle):.0f} degrees away from the body's; "
            "rotations are counted from the body's"
        )
    scale = _scale(rest, joints, body_rest, title) if options.scale is None else options.scale
    if options.scale is None and scale != 1:
        notices.append(f"lengths are multiplied by {scale:.4g} to fit the legs of the body")
    poses = _local_poses(turned, joints, corrections, body)
    return Motion(
        poses=poses,
        transl=scale * places[:, joints["pelvis"]] - body_rest["pelvis"],
        joint_names=body.tree.names,
        fps=_frame_rate(interval) if options.fps is None else options.fps,
        up=up,
        gender="unknown",
        source=where,
        notices=tuple(f"{where}: {notice}" for notice in notices),
        model=body.kind,
    )


def save_bvh(path: str | Path, motion: Motion, body: BodyModel) -> Path:
    """Write a motion as BVH: joints of the body by name, y-up, metres, degrees.

    The skeleton is the body's at rest in the motion's shape. Shape, expression and gender are not
    in the format; a `MotionNotice` names what is lost.

    Args:
        path: the `.bvh` to write; replaced as a whole, or not at all.
        motion: the motion; a z-up one is turned.
        body: gives the skeleton.

    Raises:
        ValueError: the motion has no joint of the body.
    """
    from scipy.spatial.transform import Rotation

    names = body.tree.names
    shared = [name for name in names if name in motion.joint_names]
    if not shared:
        raise ValueError(f"{motion.source}: no joint of the motion is a joint of the body.")
    for notice in _lost(motion, names):
        warnings.warn(notice, MotionNotice, stacklevel=2)
    motion = to_up(motion, body, "y")
    rest = _body_rest(body, shape_for(motion, body)[0])
    places = np.stack([rest[name] for name in names])
    offsets = places - places[[max(parent, 0) for parent in body.tree.parents]]
    offsets[0] = places[0]
    turns = ("Zrotation", "Xrotation", "Yrotation")
    channels: list[tuple[str, ...]] = [turns] * len(names)
    channels[0] = ("Xposition", "Yposition", "Zposition", *turns)
    poses = np.zeros((len(motion), len(names), 3))
    for name in shared:
        poses[:, names.index(name)] = motion.joint(name)
    with warnings.catch_warnings():
        # At a right angle two of three Euler angles turn alike; scipy picks one of many pairs.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = Rotation.from_rotvec(poses.reshape(-1, 3)).as_euler("ZXY", degrees=True)
    root = motion.transl + pelvis_of(motion, body)
    values = np.concatenate([root, angles.reshape(len(motion), -1)], axis=1)
    ends = {j: 0.5 * offsets[j] for j in range(len(names)) if not body.tree.children(j)}
    skeleton = Skeleton(names, body.tree.parents, offsets, tuple(channels))
    target = Path(path)
    with atomic_path(target) as temporary:
        temporary.write_text(write(skeleton, ends, values, 1 / motion.fps), encoding="utf-8")
    return target


def _lost(motion: Motion, names: tuple[str, ...]) -> list[str]:
    lost = [
        name for name, values in (("betas", motion.betas), ("expression", motion.expression))
        if np.any(values)
    ]  # fmt: skip
    foreign = [n for n in motion.joint_names if n not in names and motion.joint(n).any()]
    lost += [f"joints that the body has not ({', '.join(foreign)})"] if foreign else []
    return [f"{motion.source}: not in the BVH file: {', '.join(lost)}."] if lost else []


def _body_rest(body: BodyModel, betas: np.ndarray) -> dict[str, np.ndarray]:
    import jax.numpy as jnp

    joints = rest_joints(body, jnp.asarray(betas[: body.num_betas], float))
    return dict(zip(body.tree.names, np.asarray(joints, np.float64), strict=True))


def _rest_places(skeleton: Skeleton) -> Float[np.ndarray, "J 3"]:
    places = np.zeros_like(skeleton.offsets)
    for joint, parent in enumerate(skeleton.parents):
        places[joint] = skeleton.offsets[joint] + (places[parent] if parent >= 0 else 0)
    return places


def _world(
    skeleton: Skeleton, values: np.ndarray
) -> tuple[Float[np.ndarray, "T K 3 3"], Float[np.ndarray, "T K 3"], bool]:
    """Rotations and places in the world, and whether bones change their length."""
    turned, places = local_rotations(skeleton, values), local_places(skeleton, values)
    stretched = bool(np.ptp(places[:, 1:], axis=0).max(initial=0.0) > 1e-4 * np.abs(places).max())
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            local = np.einsum("tij,tj->ti", turned[:, parent], places[:, joint])
            places[:, joint] = places[:, parent] + local
            turned[:, joint] = turned[:, parent] @ turned[:, joint]
    return turned, places, stretched


def _frame_rate(interval: float) -> float:
    """Frames a second; files round the interval, so a rate next to a whole number is that."""
    rate = 1 / interval
    return float(round(rate)) if abs(rate - round(rate)) < 1e-4 * rate else rate


def _unused(skeleton: Skeleton, joints: dict[str, int], title: str, body: BodyModel) -> list[str]:
    used = {index for name, index in joints.items() if name in body.tree.names}
    left_out = [name for index, name in enumerate(skeleton.names) if index not in used]
    if not left_out:
        return []
    shown = ", ".join(left_out[:6]) + (", ..." if len(left_out) > 6 else "")
    return [f"joint map {title!r}: {len(left_out)} joints of the file are not used ({shown})"]


def _axes(rest: np.ndarray, joints: dict[str, int], where: str) -> Float[np.ndarray, "3 3"]:
    """The turn by right angles that brings the skeleton at rest y-up, facing +z."""
    up = rest[joints["head"]] - rest[joints["pelvis"]]
    left = rest[joints["left_hip"]] - rest[joints["right_hip"]]
    rows = []
    for vector in (left, up):
        row = np.zeros(3)
        row[np.abs(vector).argmax()] = np.sign(vector[np.abs(vector).argmax()])
        rows.append(row)
    frame = np.stack([rows[0], rows[1], np.cross(rows[0], rows[1])])
    if not np.isclose(np.linalg.det(frame), 1):
        raise ValueError(
            f"{where}: at rest the hips and the spine of the skeleton point along the same axis, "
            "so it does not say where up is. Export it with a rest pose that stands upright."
        )
    return frame


def _corrections(
    rest: np.ndarray, joints: dict[str, int], body_rest: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], float]:
    """$A_j$ of limbs and of hands, which go on straight from the forearm; the largest angle."""
    from scipy.spatial.transform import Rotation

    corrections, largest = {}, 0.0
    for near, far in _LIMBS.items():
        a = body_rest[far] - body_rest[near]
        b = rest[joints[far]] - rest[joints[near]]
        a, b = a / np.linalg.norm(a), b / max(float(np.linalg.norm(b)), 1e-12)
        axis = np.cross(a, b)
        sine = float(np.linalg.norm(axis))
        angle = float(np.arctan2(sine, a @ b))
        corrections[near] = Rotation.from_rotvec(axis / max(sine, 1e-12) * angle).as_matrix()
        largest = max(largest, angle)
    for side in ("left", "right"):
        fingers = (n for n in body_rest if n.startswith(f"{side}_") and n[-1] in "123")
        for name in (f"{side}_wrist", *fingers):
            corrections[name] = corrections[f"{side}_elbow"]
    return corrections, largest


def _scale(
    rest: np.ndarray, joints: dict[str, int], body_rest: dict[str, np.ndarray], title: str
) -> float:
    """Body's legs to the skeleton's, so that feet stay on the ground; 1 for SMPL-X in metres."""

    def legs(place) -> float:
        pairs = [(n, f) for n, f in _LIMBS.items() if n.endswith(("_hip", "_knee"))]
        return sum(float(np.linalg.norm(place(f) - place(n))) for n, f in pairs)

    found = legs(lambda name: rest[joints[name]])
    ratio = legs(lambda name: body_rest[name]) / max(found, 1e-12)
    return 1.0 if title == "smplx" and abs(ratio - 1) < _OWN_SCALE else ratio


def _local_poses(
    turned: Float[np.ndarray, "T K 3 3"],
    joints: dict[str, int],
    corrections: dict[str, np.ndarray],
    body: BodyModel,
) -> Float[np.ndarray, "T J 3"]:
    from scipy.spatial.transform import Rotation

    tree = body.tree
    world = np.tile(np.eye(3), (len(turned), tree.num_joints, 1, 1))
    poses = np.zeros((len(turned), tree.num_joints, 3))
    for joint, name in enumerate(tree.names):
        parent = tree.parents[joint]
        above = world[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), (len(turned), 3, 3))
        if name not in joints:
            world[:, joint] = above
            continue
        world[:, joint] = turned[:, joints[name]] @ corrections.get(name, np.eye(3))
        local = np.swapaxes(above, -1, -2) @ world[:, joint]
        poses[:, joint] = Rotation.from_matrix(local).as_rotvec()
    return poses


FORMAT = Format(
    name="bvh",
    title="BVH",
    sought="a text file that begins with HIERARCHY",
    recognise=lambda source: source.kind == "bvh",
    read=_read,
)
