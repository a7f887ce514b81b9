r"""Motions in BVH files: reading any skeleton onto a body, and writing.

BVH holds a skeleton, rotations and the position of its root; neither shape, expression nor gender.
With $G_j$ the rotation of the file's joint in the world, the body's joint has the rotation
$G_j A_j$. The constant $A_j$ takes the axes of the body's joint in the T-pose to the axes of the
file's joint. If the skeleton at zero rotations is a person (a T-pose, an A-pose), $A_j$ follows
from the directions of its limbs. Many skeletons are not: capture suits and game engines lay bones
along an axis of each joint. Then the poses of the motion give $A_j$.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..body import BodyModel, rest_joints
from ..files import atomic_path
from .bvh_text import Skeleton, local_places, local_rotations, parse, write
from .format import Format, ReadOptions, Source
from .joint_names import NEEDED, match_joints
from .record import Motion, MotionNotice, pelvis_of, shape_for
from .values import check_finite

# Limbs and the joint at their far end: rest poses differ in these (A-pose against T-pose).
_LIMBS = {
    f"{side}_{near}": f"{side}_{far}"
    for side in ("left", "right")
    for near, far in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
}
# A skeleton with SMPL-X's names is SMPL-X at rest in some shape, in metres, if it differs from the
# body by no more than this.
_OWN_SCALE, _OWN_ANGLE = 0.25, np.radians(10.0)
# A limb at rest further than this from the T-pose is no rest pose of a person. Arms that hang are
# 90 degrees away.
_NO_PERSON = np.radians(100.0)
_STANDS = 0.5  # mean height of the head above the pelvis, of their distance


@dataclass(frozen=True)
class _Posed:
    """A skeleton with its poses, in the axes of the file.

    Attributes:
        rest: places of its joints at zero rotations.
        turned, places: rotations and places of its joints in the world over time.
        joints: the skeleton's joint for each joint of SMPL-X that it has.
    """

    rest: Float[np.ndarray, "K 3"]
    turned: Float[np.ndarray, "T K 3 3"]
    places: Float[np.ndarray, "T K 3"]
    joints: dict[str, int]

    def place(self, name: str) -> Float[np.ndarray, "T 3"]:
        return self.places[:, self.joints[name]]

    def seen_from(self, near: str, far: str) -> Float[np.ndarray, 3]:
        """Mean place of one joint in the axes of another."""
        apart = self.place(far) - self.place(near)
        local = np.einsum("tji,tj->ti", self.turned[:, self.joints[near]], apart)
        return local.mean(axis=0)


def _read(source: Source, options: ReadOptions) -> Motion:
    where = str(source.path)
    up, body = options.turned(where), options.body
    if body is None:
        raise ValueError(
            f"{where}: BVH holds the position of a pelvis and its own rest pose. Pass "
            "body=xa.load_body(...), the body that is to move."
        )
    skeleton, values, interval = parse(source.data, where)
    if len(values) == 0:
        raise ValueError(f"{where}: the motion has no frames.")
    check_finite(values, "the motion", where)
    if options.fps is None and not interval > 0:
        raise ValueError(f"{where}: Frame Time: {interval}; it must be positive. Give fps=.")
    title, joints = match_joints(skeleton.names, options.joint_map, where, skeleton.parents)
    lacking = [name for name in NEEDED if name not in body.tree.names]
    if lacking:
        raise ValueError(
            f"{where}: the body ({body.source.describe()}) has no {', '.join(lacking)}; BVH is "
            "read for bodies with the joint names of SMPL-X."
        )
    notices = _unused(skeleton, joints, title, body)
    body_rest = _body_rest(body, np.zeros(0))
    turned, places, stretched = _world(skeleton, values)
    if stretched:
        notices.append("joints below the root move against their parents; that is left out")
    posed = _Posed(_rest_places(skeleton), turned, places, joints)
    world, axes = _axes(posed, body, body_rest, title, notices)
    scale = _scale(posed, body_rest, title) if options.scale is None else options.scale
    if options.scale is None and scale != 1:
        notices.append(f"lengths are multiplied by {scale:.4g} to fit the legs of the body")
    return Motion(
        poses=_local_poses(world @ turned, joints, axes, body),
        transl=scale * posed.place("pelvis") @ world.T - body_rest["pelvis"],
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
        path: the `.bvh` to write; an existing file is replaced when writing has succeeded.
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
    motion = motion.to_y_up(body)
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
        # At a right angle two of three Euler angles have the same axis; scipy picks one solution.
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
    lost += [f"joints that the body lacks ({', '.join(foreign)})"] if foreign else []
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
    """Frames per second; files round the interval, so a rate near a whole number is that number."""
    rate = 1 / interval
    return float(round(rate)) if abs(rate - round(rate)) < 1e-4 * rate else rate


def _unused(skeleton: Skeleton, joints: dict[str, int], title: str, body: BodyModel) -> list[str]:
    used = {index for name, index in joints.items() if name in body.tree.names}
    left_out = [name for index, name in enumerate(skeleton.names) if index not in used]
    if not left_out:
        return []
    shown = ", ".join(left_out[:6]) + (", ..." if len(left_out) > 6 else "")
    return [f"joint map {title!r}: {len(left_out)} joints of the file are not used ({shown})"]


# The axes of the world and of the joints


def _axes(
    posed: _Posed,
    body: BodyModel,
    body_rest: dict[str, np.ndarray],
    title: str,
    notices: list[str],
) -> tuple[Float[np.ndarray, "3 3"], dict[str, np.ndarray]]:
    """The turn that brings the world y-up, and $A_j$ of the joints where it is no identity."""
    frame = _rest_frame(posed)
    corrections, angle = {}, np.inf
    if frame is not None:
        corrections, angle = _corrections(posed.rest @ frame.T, posed.joints, body_rest)
    world, reason = _world_turn(posed, frame if angle < _NO_PERSON else None)
    notices += reason
    if frame is not None and angle < _NO_PERSON:
        if not np.array_equal(frame, np.eye(3)) and np.array_equal(frame, world):
            notices.append("the skeleton at rest is not y-up facing +z; it was turned")
        if title == "smplx" and angle < _OWN_ANGLE:
            corrections = {}
        elif angle > np.radians(1):
            notices.append(
                f"limbs at rest point up to {np.degrees(angle):.0f} degrees away from the body's; "
                "rotations are counted from the body's"
            )
        if np.array_equal(frame, np.eye(3)):
            return world, corrections
        names = {name: corrections.get(name, np.eye(3)) for name in posed.joints}
        return world, {name: frame.T @ turn for name, turn in names.items()}
    notices.append(
        "the skeleton at rest is not a person (bones lie along the axes of their joints), so the "
        "axes of its joints are taken from the poses; limbs are exact, and their twist counts from "
        "its mean over the motion"
    )
    return world, _axes_from_poses(posed, world, body, body_rest)


def _rest_frame(posed: _Posed) -> Float[np.ndarray, "3 3"] | None:
    """The turn by right angles that brings the rest pose y-up, facing +z, if there is one."""
    rest, joints = posed.rest, posed.joints
    up = rest[joints["head"]] - rest[joints["pelvis"]]
    left = rest[joints["left_hip"]] - rest[joints["right_hip"]]
    rows = [_nearest_axis(vector) for vector in (left, up)]
    frame = np.stack([*rows, np.cross(*rows)])  # pyright: ignore[reportArgumentType, reportCallIssue]
    return frame if np.isclose(np.linalg.det(frame), 1) else None


def _nearest_axis(vector: Float[np.ndarray, 3]) -> Float[np.ndarray, 3]:
    axis = np.zeros(3)
    largest = np.abs(vector).argmax()
    axis[largest] = np.sign(vector[largest])
    return axis


def _world_turn(
    posed: _Posed, frame: Float[np.ndarray, "3 3"] | None
) -> tuple[Float[np.ndarray, "3 3"], list[str]]:
    """The turn by right angles after which the person stands along y, and notices.

    The rest pose gives it, if it has one and the motion stands after that turn. Otherwise the poses
    decide: the direction from the pelvis to the head, and from the feet to the pelvis.
    """
    upright = _upright(posed)
    if frame is not None and (frame @ upright)[1] > _STANDS:
        return frame, []
    axis = _nearest_axis(upright)
    stands = float(axis @ upright) > _STANDS
    if frame is None:
        if not stands:
            return np.eye(3), [
                "neither the skeleton at rest nor the poses say which axis points up; y is assumed"
            ]
        turn = _least_turn(axis)
        if np.array_equal(turn, np.eye(3)):
            return turn, []
        return turn, ["the person stands along another axis than y; the world was turned"]
    if upright[1] > _STANDS and not np.array_equal(frame, np.eye(3)):
        return np.eye(3), [
            "the skeleton at rest is not y-up, but the person stands along y; the world is kept"
        ]
    if stands and not np.array_equal(frame, np.eye(3)):
        return frame, [
            "the skeleton at rest stands along another axis than the person in the motion; the "
            "axes of the rest pose are used, so the person may lie"
        ]
    return frame, []


def _upright(posed: _Posed) -> Float[np.ndarray, 3]:
    """Mean over time of the unit vectors from the pelvis to the head and from the feet to it."""
    pelvis = posed.place("pelvis")
    feet = (posed.place("left_ankle") + posed.place("right_ankle")) / 2
    parts = []
    for vector in (posed.place("head") - pelvis, pelvis - feet):
        parts.append(vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-12))
    return np.mean(parts, axis=(0, 1))


def _least_turn(up: Float[np.ndarray, 3]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that brings an axis to y; about x for half a turn."""
    y = np.array([0.0, 1.0, 0.0])
    if up @ y > 0.5:
        return np.eye(3)
    if up @ y < -0.5:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.cross(up, y)
    return np.stack([axis, y, np.cross(axis, y)]).T @ np.stack([axis, up, np.cross(axis, up)])


def _corrections(
    rest: np.ndarray, joints: dict[str, int], body_rest: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], float]:
    """$A_j$ of limbs, and of hands, which extend the forearm; and the largest angle."""
    corrections, largest = {}, 0.0
    for near, far in _LIMBS.items():
        a = body_rest[far] - body_rest[near]
        b = rest[joints[far]] - rest[joints[near]]
        corrections[near], angle = _between(a, b)
        largest = max(largest, angle)
    for side in ("left", "right"):
        fingers = (n for n in body_rest if n.startswith(f"{side}_") and n[-1] in "123")
        for name in (f"{side}_wrist", *fingers):
            corrections[name] = corrections[f"{side}_elbow"]
    return corrections, largest


def _between(
    a: Float[np.ndarray, 3], b: Float[np.ndarray, 3]
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """The least rotation from one direction to another, and its angle."""
    from scipy.spatial.transform import Rotation

    a, b = a / max(float(np.linalg.norm(a)), 1e-12), b / max(float(np.linalg.norm(b)), 1e-12)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, a @ b))
    if sine < 1e-9:  # parallel, or opposite: any axis across
        across = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        axis, sine = across, max(float(np.linalg.norm(across)), 1e-12)
    return Rotation.from_rotvec(axis / sine * angle).as_matrix(), angle


def _axes_from_poses(
    posed: _Posed,
    world: Float[np.ndarray, "3 3"],
    body: BodyModel,
    body_rest: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """$A_j$ from the poses of the motion.

    Joints with several neighbours below them (pelvis, chest) take the rotation that fits the
    directions to these. Other joints point to the next one; the twist about that direction is the
    one that makes the joint's mean rotation relative to its parent least. Joints at the end of a
    chain have no mean rotation.
    """
    tree, axes, turned = body.tree, {}, {}
    still = np.broadcast_to(np.eye(3), (len(posed.turned), 3, 3))
    for joint, name in enumerate(tree.names):
        parent = tree.parents[joint]
        above = turned[parent] if parent >= 0 else still
        if name not in posed.joints:
            turned[joint] = above
            continue
        local = world @ posed.turned[:, posed.joints[name]]
        targets = [t for t in _targets(name) if t in posed.joints and t in body_rest]
        ours = [body_rest[t] - body_rest[name] for t in targets]
        theirs = [posed.seen_from(name, t) for t in targets]
        relative = np.einsum("tji,tjk->ik", above, local)  # summed over time
        if len(targets) >= 2:
            axes[name] = _aligned(ours, theirs)
        elif targets:
            swing, _ = _between(ours[0], theirs[0])
            axes[name] = swing @ _least_twist(relative @ swing, ours[0])
        else:
            axes[name] = _nearest_rotation(relative.T)
        turned[joint] = local @ axes[name]
    return axes


def _targets(name: str) -> tuple[str, ...]:
    """Joints whose directions fix the axes of a joint: two or more, or the next of its chain."""
    fixed = {
        "pelvis": ("left_hip", "right_hip", "neck", "head"),
        "spine3": ("neck", "left_shoulder", "right_shoulder"),
        "spine1": ("spine3",), "spine2": ("spine3",), "neck": ("head",),
    }  # fmt: skip
    if name in fixed:
        return fixed[name]
    side, _, part = name.partition("_")
    chain = {
        "hip": "knee", "knee": "ankle", "ankle": "foot", "collar": "shoulder", "shoulder": "elbow",
        "elbow": "wrist", "wrist": "middle1",
    }  # fmt: skip
    if part in chain:
        return (f"{side}_{chain[part]}",)
    return (f"{name[:-1]}{int(name[-1]) + 1}",) if name[-1] in "12" else ()


def _aligned(ours: list[np.ndarray], theirs: list[np.ndarray]) -> Float[np.ndarray, "3 3"]:
    """The rotation from directions to directions, least squares (Kabsch)."""
    a = np.stack([v / max(float(np.linalg.norm(v)), 1e-12) for v in ours])
    b = np.stack([v / max(float(np.linalg.norm(v)), 1e-12) for v in theirs])
    return _nearest_rotation(b.T @ a)


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    u, _, v = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v


def _least_twist(
    matrix: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, 3]
) -> Float[np.ndarray, "3 3"]:
    r"""The rotation $R$ about an axis $b$ with the largest trace of $M R$.

    With angle $\varphi$ the trace is $\cos\varphi\,(\mathrm{tr}\,M - b^T M b) + \sin\varphi\,
    \mathrm{tr}(M [b]_\times) + b^T M b$.
    """
    from scipy.spatial.transform import Rotation

    b = axis / max(float(np.linalg.norm(axis)), 1e-12)
    cross = np.array([[0, -b[2], b[1]], [b[2], 0, -b[0]], [-b[1], b[0], 0]])
    angle = np.arctan2(np.trace(matrix @ cross), np.trace(matrix) - b @ matrix @ b)
    return Rotation.from_rotvec(angle * b).as_matrix()


def _scale(posed: _Posed, body_rest: dict[str, np.ndarray], title: str) -> float:
    """Body's legs to the skeleton's, so that feet stay on the ground; 1 for SMPL-X in metres."""

    def legs(place) -> float:
        pairs = [(n, f) for n, f in _LIMBS.items() if n.endswith(("_hip", "_knee"))]
        return sum(float(np.linalg.norm(place(f) - place(n))) for n, f in pairs)

    found = legs(lambda name: posed.rest[posed.joints[name]])
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
