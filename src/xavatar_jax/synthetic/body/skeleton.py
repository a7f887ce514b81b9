"""The rest skeleton: the SMPL-X joint tree with original joint positions.

The body stands 1.73 m tall in a T-pose: metres, Y up, facing +Z, the person's left at +X, palms
down, fingers straight. Segment lengths follow adult means of body-segment tables (Drillis and
Contini 1966, as fractions of stature) and of hand surveys (Greiner 1991, Buryanov and Kotiuk
2010, phalanx lengths in millimetres), rounded. The origin is in the upper chest.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ...body.joints import FINGERS, SMPLX_TREE

JOINT_NAMES, PARENTS = SMPLX_TREE.names, SMPLX_TREE.parents
JOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINT_NAMES)}

_MIDLINE_AND_LEFT = {
    "pelvis": (0.0, -0.350, -0.005),
    "left_hip": (0.082, -0.440, -0.012),
    "spine1": (0.0, -0.245, -0.020),
    "left_knee": (0.104, -0.835, -0.010),
    "spine2": (0.0, -0.110, -0.025),
    "left_ankle": (0.098, -1.212, -0.045),
    "spine3": (0.0, 0.035, -0.030),
    "left_foot": (0.112, -1.262, 0.068),
    "neck": (0.0, 0.160, -0.035),
    "left_collar": (0.045, 0.090, -0.025),
    "head": (0.0, 0.285, -0.012),
    "left_shoulder": (0.172, 0.098, -0.028),
    "left_elbow": (0.430, 0.092, -0.040),
    "left_wrist": (0.690, 0.095, -0.036),
    "jaw": (0.0, 0.288, 0.004),
    "left_eye": (0.032, 0.334, 0.0635),
}

# Finger rays in the left hand's frame: +X to the finger tips, +Y to the back of the hand,
# +Z to the thumb. Knuckle relative to the wrist, direction, then the three phalanx lengths
# (the last one to the tip's centre of curvature).
_FINGER_RAYS = {
    "index": ((0.090, 0.001, 0.0265), (0.995, -0.02, 0.095), (0.040, 0.0245, 0.0170)),
    "middle": ((0.092, 0.003, 0.0040), (1.000, -0.02, 0.012), (0.0445, 0.0280, 0.0180)),
    "ring": ((0.087, 0.001, -0.0175), (0.996, -0.02, -0.080), (0.0410, 0.0260, 0.0175)),
    "pinky": ((0.079, -0.004, -0.0370), (0.985, -0.02, -0.175), (0.0320, 0.0195, 0.0155)),
}

# The thumb points forwards and to the palmar side, so that it can oppose.
_THUMB_BASE = (0.020, -0.009, 0.0220)
_THUMB_RAY = (
    ((0.700, -0.300, 0.650), 0.0450),
    ((0.800, -0.220, 0.560), 0.0330),
    ((0.860, -0.180, 0.480), 0.0200),
)


def _unit(vector: tuple[float, ...]) -> np.ndarray:
    array = np.asarray(vector, dtype=np.float64)
    return array / np.linalg.norm(array)


def finger_chain(finger: str) -> Float[np.ndarray, "4 3"]:
    """Three joints and the tip's centre of one left finger, metres."""
    wrist = np.asarray(_MIDLINE_AND_LEFT["left_wrist"])
    if finger == "thumb":
        points = [wrist + np.asarray(_THUMB_BASE)]
        for direction, length in _THUMB_RAY:
            points.append(points[-1] + length * _unit(direction))
        return np.stack(points)
    knuckle, direction, lengths = _FINGER_RAYS[finger]
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    return wrist + np.asarray(knuckle) + along[:, None] * _unit(direction)


def rest_joints() -> Float[np.ndarray, "55 3"]:
    """Rest joint positions in SMPL-X order, metres, left-right symmetric."""
    places = {name: np.asarray(p, dtype=np.float64) for name, p in _MIDLINE_AND_LEFT.items()}
    for finger in FINGERS:
        for i, point in enumerate(finger_chain(finger)[:3], start=1):
            places[f"left_{finger}{i}"] = point
    mirror = np.array([-1.0, 1.0, 1.0])
    for name in list(places):
        if name.startswith("left_"):
            places["right_" + name[5:]] = places[name] * mirror
    return np.stack([places[name] for name in JOINT_NAMES])


def mirrored_joint(joint: int) -> int:
    """The joint on the other side of the body; midline joints map to themselves."""
    name = JOINT_NAMES[joint]
    if name.startswith("left_"):
        return JOINT_INDEX["right_" + name[5:]]
    if name.startswith("right_"):
        return JOINT_INDEX["left_" + name[6:]]
    return joint
