"""Hand shapes, as the flexion of each finger joint in degrees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

FINGERS = ("index", "middle", "ring", "pinky")
_PALM = np.array([0.0, -1.0, 0.0])  # palms face down at rest
_SPREAD_SIGN = {"index": -1.0, "middle": -1.0, "ring": 1.0, "pinky": 1.0}  # away from the middle


class Finger(NamedTuple):
    """Flexion of knuckle, middle and last joint, and spread from the middle finger."""

    knuckle: float
    middle: float
    last: float
    spread: float = 0.0


class Thumb(NamedTuple):
    """Thumb angles.

    Attributes:
        down: base, out of the plane of the palm to the palmar side.
        across: base, across the palm towards the little finger; negative opens the hand.
        roll: base, rotating the pad towards the fingers.
        middle, last: flexion of the other two joints.
    """

    down: float
    across: float
    roll: float
    middle: float
    last: float


class HandShape(NamedTuple):
    index: Finger
    middle: Finger
    ring: Finger
    pinky: Finger
    thumb: Thumb


def _same(finger: Finger, thumb: Thumb) -> HandShape:
    return HandShape(finger, finger, finger, finger, thumb)


_OUT = Finger(0, 0, 0)
_IN = Finger(82, 98, 62)
_THUMB_OVER = Thumb(38, 12, 41, 41, 38)

TRAIN_SHAPES: dict[str, HandShape] = {
    "flat": _same(_OUT, Thumb(0, 0, 0, 0, 0)),
    "relaxed": HandShape(
        Finger(18, 24, 12, 2), Finger(24, 30, 14), Finger(28, 34, 16, 1), Finger(30, 36, 16, 4),
        Thumb(12, 4, 10, 10, 12),
    ),
    "spread": HandShape(
        Finger(-6, 2, 0, 14), Finger(-4, 2, 0, 2), Finger(-5, 2, 0, 12), Finger(-6, 4, 0, 22),
        Thumb(4, -22, 0, -4, -6),
    ),
    "power": HandShape(
        Finger(46, 56, 32, 3), Finger(50, 60, 34), Finger(53, 62, 34, 1), Finger(56, 62, 34, 4),
        Thumb(34, 12, 34, 14, 22),
    ),
    "cylinder": HandShape(
        Finger(34, 44, 24, 3), Finger(38, 46, 26), Finger(40, 48, 26, 1), Finger(42, 48, 26, 3),
        Thumb(36, 4, 30, 8, 14),
    ),
    "pinch": HandShape(
        Finger(50, 44, 20, 1), Finger(26, 28, 14, 1), Finger(22, 26, 12, 3), Finger(18, 22, 10, 9),
        Thumb(29, 11, 36, 16, 24),
    ),
    "lateral": HandShape(
        Finger(46, 74, 40), Finger(58, 82, 48), Finger(64, 86, 50), Finger(66, 86, 50),
        Thumb(2, 14, 7, 11, 18),
    ),
    "hook": HandShape(
        Finger(6, 80, 46), Finger(8, 84, 48), Finger(8, 84, 48), Finger(10, 80, 46, 3),
        Thumb(4, -4, 4, 6, 10),
    ),
    "fist": HandShape(_IN, _IN, _IN, _IN, _THUMB_OVER),
    "point": HandShape(Finger(2, 4, 2), _IN, _IN, _IN, _THUMB_OVER),
    "thumbs_up": HandShape(_IN, _IN, _IN, _IN, Thumb(-14, -26, -6, -8, -14)),
    "ok": HandShape(
        Finger(52, 48, 24, 3), Finger(8, 10, 4, 2), Finger(2, 8, 4, 8), Finger(-4, 6, 2, 18),
        Thumb(34, 8, 35, 17, 26),
    ),
    "two": HandShape(
        Finger(0, 2, 0, 10), Finger(0, 2, 0, 6), _IN, _IN, Thumb(44, 27, 36, 34, 38)
    ),
    "three": HandShape(
        Finger(0, 2, 0, 10), Finger(0, 2, 0), Finger(2, 4, 2, 10), Finger(78, 92, 56),
        Thumb(51, 45, 32, 21, 27),
    ),
    "four": HandShape(
        Finger(0, 2, 0, 9), Finger(0, 2, 0), Finger(0, 2, 0, 8), Finger(0, 4, 0, 15),
        Thumb(30, 36, 26, 36, 40),
    ),
    "phone": HandShape(
        Finger(30, 34, 16, 4), Finger(42, 44, 22), Finger(48, 48, 24), Finger(52, 48, 24, 3),
        Thumb(30, -6, 22, 4, 8),
    ),
    "box": HandShape(
        Finger(10, 8, 4, 7), Finger(8, 8, 4), Finger(10, 8, 4, 6), Finger(12, 10, 4, 11),
        Thumb(18, -14, 10, 2, 4),
    ),
}  # fmt: skip

TEST_SHAPES: dict[str, HandShape] = {
    "tripod": HandShape(
        Finger(54, 34, 10), Finger(60, 40, 14), Finger(72, 76, 40), Finger(76, 76, 40),
        Thumb(25, 24, 36, 3, 3),
    ),
    "sphere": HandShape(
        Finger(28, 46, 34, 13), Finger(26, 48, 36, 1), Finger(28, 48, 36, 12),
        Finger(32, 48, 36, 22), Thumb(44, -12, 30, 12, 26),
    ),
    "horns": HandShape(Finger(-2, 2, 0, 5), _IN, _IN, Finger(-2, 4, 0, 14), _THUMB_OVER),
    "shaka": HandShape(_IN, _IN, _IN, Finger(-4, 4, 2, 22), Thumb(2, -24, 0, -6, -10)),
    "gun": HandShape(
        Finger(0, 2, 0), Finger(2, 4, 2), _IN, _IN, Thumb(-8, -26, -4, -6, -12)
    ),
    "claw": HandShape(
        Finger(-18, 76, 52, 10), Finger(-16, 78, 54, 2), Finger(-16, 78, 54, 9),
        Finger(-18, 76, 52, 18), Thumb(20, -18, 8, 38, 46),
    ),
    "duck": HandShape(
        Finger(72, 6, 2), Finger(74, 6, 2), Finger(73, 6, 2), Finger(70, 8, 2),
        Thumb(48, 4, 34, 4, 4),
    ),
    "keys": HandShape(
        Finger(44, 12, 6, 6), Finger(12, 46, 24, 2), Finger(40, 14, 8, 6), Finger(8, 40, 22, 14),
        Thumb(16, -10, 8, 22, 10),
    ),
}  # fmt: skip

HAND_SHAPES = {**TRAIN_SHAPES, **TEST_SHAPES}


def left_hand_pose(
    shape: HandShape, joints: dict[str, np.ndarray]
) -> dict[str, Float[np.ndarray, 3]]:
    """Axis-angle vectors of the 15 joints of the left hand, by name, radians.

    The axes come from the rest positions of the joints: a finger flexes about the axis
    perpendicular to it and to the palm's normal, the thumb about an axis oblique to the palm.

    Args:
        shape: the angles.
        joints: rest positions by joint name, metres, T-pose with the palm down.
    """
    pose = {}
    for finger in FINGERS:
        bend = getattr(shape, finger)
        along = _direction(joints, finger)
        axis = np.cross(along, _PALM)
        spread = _SPREAD_SIGN[finger] * np.array([0.0, bend.spread, 0.0])
        for k, angle in ((1, bend.knuckle), (2, bend.middle), (3, bend.last)):
            vector = axis / np.linalg.norm(axis) * angle + (spread if k == 1 else 0.0)
            pose[f"left_{finger}{k}"] = np.deg2rad(vector)
    return pose | _thumb_pose(shape.thumb, joints)


def _thumb_pose(thumb: Thumb, joints: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    from scipy.spatial.transform import Rotation

    along = _direction(joints, "thumb")

    def about(target: tuple[float, float, float]) -> np.ndarray:
        axis = np.cross(along, np.asarray(target))
        return axis / np.linalg.norm(axis)

    base = (
        Rotation.from_rotvec(np.deg2rad(thumb.down) * about((0.0, -1.0, 0.0)))
        * Rotation.from_rotvec(np.deg2rad(thumb.across) * about((0.0, 0.0, -1.0)))
        * Rotation.from_rotvec(np.deg2rad(thumb.roll) * along)
    )
    bending = about((0.0, -0.45, -0.9))
    return {
        "left_thumb1": base.as_rotvec(),
        "left_thumb2": np.deg2rad(thumb.middle) * bending,
        "left_thumb3": np.deg2rad(thumb.last) * bending,
    }


def _direction(joints: dict[str, np.ndarray], finger: str) -> np.ndarray:
    offset = joints[f"left_{finger}3"] - joints[f"left_{finger}1"]
    return offset / np.linalg.norm(offset)
