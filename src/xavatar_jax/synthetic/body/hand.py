"""The left hand's implicit surface: palm, four fingers and an opposable thumb."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .field import carve, cone, ellipsoid, offset, smooth_min
from .skeleton import JOINT_INDEX, finger_chain, rest_joints

HAND_BOX = np.array([[0.66, 0.02, -0.12], [0.93, 0.14, 0.11]])

# Radii at the three joints and at the tip.
FINGER_RADII = {
    "index": (0.0102, 0.0088, 0.0077, 0.0067),
    "middle": (0.0104, 0.0090, 0.0079, 0.0069),
    "ring": (0.0098, 0.0085, 0.0075, 0.0065),
    "pinky": (0.0089, 0.0075, 0.0066, 0.0058),
    "thumb": (0.0150, 0.0112, 0.0097, 0.0079),
}


def _finger(p: np.ndarray, finger: str) -> np.ndarray:
    chain, radii = finger_chain(finger), FINGER_RADII[finger]
    f = np.full(len(p), 1.0)
    for i in range(3):
        # Phalanges are a little slimmer between the joints than at them.
        slim = 0.94 if i else 0.97
        middle = 0.5 * (chain[i] + chain[i + 1])
        r_mid = slim * 0.5 * (radii[i] + radii[i + 1])
        f = smooth_min(f, cone(p, chain[i], middle, radii[i], r_mid), 0.004)
        f = smooth_min(f, cone(p, middle, chain[i + 1], r_mid, radii[i + 1]), 0.004)
    # The tip is flatter than it is wide.
    axis = chain[3] - chain[2]
    axis = axis / np.linalg.norm(axis)
    side = np.cross(axis, (0.0, 1.0, 0.0))
    side = side / np.linalg.norm(side)
    frame = np.stack([axis, np.cross(side, axis), side])
    r = radii[3]
    tip = ellipsoid(p, chain[3] - 0.002 * axis, (1.45 * r, 1.0 * r, 1.08 * r), frame)
    return smooth_min(f, tip, 0.004)


def hand_field(p: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Left hand; its wrist end is rounded and lies inside the forearm."""
    wrist = rest_joints()[JOINT_INDEX["left_wrist"]]
    palm = cone(
        p, offset(wrist, -0.015, 0.0, -0.006), offset(wrist, 0.02, 0.0, -0.008), 0.0180, 0.0175
    )
    palm = smooth_min(
        palm,
        cone(p, offset(wrist, -0.015, 0.0, 0.007), offset(wrist, 0.02, 0.0, 0.008), 0.018, 0.017),
        0.01,
    )
    for finger in ("index", "middle", "ring", "pinky"):
        knuckle = finger_chain(finger)[0]
        start = wrist + np.array([0.016, 0.0, 0.55 * (knuckle - wrist)[2]])
        end = knuckle + np.array([-0.004, -0.002, 0.0])
        palm = smooth_min(palm, cone(p, start, end, 0.0155, 0.0118), 0.012)
    thumb = finger_chain("thumb")
    ball = thumb[0] + 0.45 * (thumb[1] - thumb[0])
    axis = (thumb[1] - thumb[0]) / np.linalg.norm(thumb[1] - thumb[0])
    up = np.array([0.0, 1.0, 0.0]) - axis * axis[1]
    up = up / np.linalg.norm(up)
    frame = np.stack([axis, up, np.cross(axis, up)])
    thenar = ellipsoid(p, offset(ball, 0.004, -0.004, -0.008), (0.031, 0.0155, 0.0165), frame)
    palm = smooth_min(palm, thenar, 0.012)
    hypothenar = ellipsoid(p, offset(wrist, 0.042, -0.008, -0.026), (0.034, 0.0125, 0.0130))
    palm = smooth_min(palm, hypothenar, 0.010)
    hollow = ellipsoid(p, offset(wrist, 0.055, -0.0255, 0.002), (0.026, 0.0125, 0.016))
    palm = carve(palm, hollow, 0.014)

    fingers = np.full(len(p), 1.0)
    for finger in ("index", "middle", "ring", "pinky"):
        fingers = smooth_min(fingers, _finger(p, finger), 0.0015)
    for finger in ("index", "middle", "ring", "pinky"):
        chain = finger_chain(finger)
        knuckle = ellipsoid(p, offset(chain[0], 0.0, 0.0045, 0.0), (0.011, 0.0072, 0.0080))
        palm = smooth_min(palm, knuckle, 0.008)
    # Webs: the fingers separate at a third of their first phalanx.
    for one, other in (("index", "middle"), ("middle", "ring"), ("ring", "pinky")):
        a, b = finger_chain(one), finger_chain(other)
        start = a[0] + 0.28 * (a[1] - a[0]) + (0.0, -0.002, 0.0)
        end = b[0] + 0.28 * (b[1] - b[0]) + (0.0, -0.002, 0.0)
        palm = smooth_min(palm, cone(p, start, end, 0.0062, 0.0062), 0.008)
    f = smooth_min(palm, fingers, 0.006)
    return smooth_min(f, _finger(p, "thumb"), 0.010)
