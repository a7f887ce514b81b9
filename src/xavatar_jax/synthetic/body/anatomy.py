"""The body's implicit surface: trunk, limbs and feet, joined with the head and the hands.

All lengths are metres in the rest pose. The field is even in x, so the body is symmetric.
Sections follow adult breadths and depths in anthropometric surveys (ANSUR II means, rounded).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from .field import (
    Sweep,
    Vector,
    carve,
    cone,
    ellipsoid,
    offset,
    smooth_min,
)
from .hand import HAND_BOX, hand_field
from .head import HEAD_BOX, head_field
from .skeleton import JOINT_INDEX, rest_joints

# Bounds of the person, and the distance from a piece's box within which it is evaluated.
BODY_BOX = np.array([[-0.96, -1.344, -0.24], [0.96, 0.528, 0.24]])
_REACH = 0.06
_MIDLINE_FILLET = 0.012


def _joint(name: str) -> np.ndarray:
    return rest_joints()[JOINT_INDEX[name]]


def _along_y(keys: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
    """Rows (y, half width, front z, back z) as section keys, centred in depth."""
    rows = []
    for y, width, front, back in keys:
        rows.append((y, 0.0, 0.5 * (front + back), width, *(2 * [0.5 * (front - back)])))
    return rows


_Piece = tuple[Callable[[np.ndarray], np.ndarray], np.ndarray, float]


def _box(*points: Vector, pad: float) -> np.ndarray:
    stacked = np.asarray(points, dtype=float)
    return np.stack([stacked.min(0) - pad, stacked.max(0) + pad])


def _trunk() -> list[_Piece]:
    trunk = Sweep(
        (0, 0, 0),
        (0, 1, 0),
        (1, 0, 0),
        _along_y(
            [
                (-0.475, 0.120, 0.070, -0.095),
                (-0.435, 0.150, 0.083, -0.112),
                (-0.390, 0.156, 0.090, -0.116),
                (-0.330, 0.151, 0.093, -0.108),
                (-0.270, 0.138, 0.094, -0.092),
                (-0.210, 0.131, 0.092, -0.084),
                (-0.140, 0.138, 0.095, -0.092),
                (-0.060, 0.154, 0.104, -0.106),
                (0.000, 0.165, 0.104, -0.112),
                (0.050, 0.164, 0.090, -0.112),
                (0.090, 0.146, 0.066, -0.104),
                (0.125, 0.100, 0.038, -0.092),
                (0.150, 0.062, 0.022, -0.082),
            ]
        ),
        caps=(0.035, 0.03),
        squareness=2.35,
    )
    neck = Sweep(
        (0, 0.10, -0.040),
        (0, 1, 0.17),
        (1, 0, 0),
        [
            (0.0, 0, 0, 0.070, 0.058, 0.058),
            (0.05, 0, 0, 0.0560, 0.053, 0.055),
            (0.10, 0, 0, 0.0515, 0.052, 0.053),
            (0.20, 0, 0, 0.0520, 0.052, 0.050),
        ],
        caps=(0.03, 0.03),
    )
    glute = (0.078, -0.420, -0.068)
    chest = (0.076, 0.002, 0.056)
    return [
        (trunk, _box((-0.17, -0.51, -0.13), (0.17, 0.18, 0.11), pad=0.02), 0.02),
        (neck, _box((-0.06, 0.07, -0.10), (0.06, 0.33, 0.06), pad=0.02), 0.035),
        # Trapezius and shoulder girdle, then the deltoid's cap.
        (
            lambda p: cone(p, (0.030, 0.165, -0.055), (0.150, 0.106, -0.036), 0.030, 0.034),
            _box((0.03, 0.16, -0.05), (0.15, 0.1, -0.03), pad=0.04),
            0.050,
        ),
        (
            lambda p: ellipsoid(p, (0.186, 0.090, -0.030), (0.062, 0.057, 0.055)),
            _box((0.178, 0.088, -0.03), pad=0.06),
            0.040,
        ),
        # Clavicle, pectoral, shoulder blade, buttock.
        (
            lambda p: cone(p, (0.020, 0.120, 0.018), (0.140, 0.125, -0.008), 0.012, 0.012),
            _box((0.02, 0.115, 0.02), (0.14, 0.125, -0.005), pad=0.02),
            0.020,
        ),
        (
            lambda p: ellipsoid(p, chest, (0.074, 0.062, 0.052)),
            _box(chest, pad=0.075),
            0.030,
        ),
        (
            lambda p: ellipsoid(p, (0.085, 0.030, -0.088), (0.058, 0.075, 0.034)),
            _box((0.085, 0.03, -0.088), pad=0.08),
            0.030,
        ),
        (
            lambda p: ellipsoid(p, glute, (0.074, 0.074, 0.062)),
            _box(glute, pad=0.08),
            0.035,
        ),
    ]


def _leg() -> list[_Piece]:
    hip, knee, ankle = np.array([0.090, -0.440, -0.010]), _joint("left_knee"), _joint("left_ankle")
    thigh = Sweep(
        hip,
        knee - hip,
        (1, 0, 0),
        [
            (0.00, 0.000, 0.000, 0.0765, 0.084, 0.092),
            (0.06, 0.000, 0.000, 0.0780, 0.088, 0.088),
            (0.12, 0.002, 0.002, 0.0765, 0.085, 0.080),
            (0.20, 0.002, 0.004, 0.0690, 0.076, 0.072),
            (0.29, 0.001, 0.003, 0.0575, 0.063, 0.062),
            (0.35, 0.000, 0.002, 0.0520, 0.056, 0.056),
            (0.395, 0.000, 0.000, 0.0500, 0.056, 0.055),
            (0.430, 0.000, 0.000, 0.0490, 0.052, 0.054),
        ],
        caps=(0.06, 0.04),
    )
    shin = Sweep(
        knee,
        ankle - knee,
        (1, 0, 0),
        [
            (-0.03, 0.000, 0.000, 0.049, 0.052, 0.054),
            (0.02, 0.000, 0.000, 0.0485, 0.053, 0.055),
            (0.06, 0.001, 0.000, 0.0500, 0.048, 0.062),
            (0.11, 0.002, 0.000, 0.0540, 0.045, 0.072),
            (0.16, 0.002, 0.002, 0.0520, 0.043, 0.070),
            (0.22, 0.001, 0.003, 0.0440, 0.040, 0.056),
            (0.28, 0.000, 0.004, 0.0355, 0.037, 0.043),
            (0.33, 0.000, 0.002, 0.0310, 0.036, 0.038),
            (0.37, 0.000, 0.000, 0.0330, 0.039, 0.040),
            (0.40, 0.000, 0.000, 0.0350, 0.045, 0.042),
        ],
        caps=(0.04, 0.03),
    )
    legs = [
        (thigh, _box(hip, knee, pad=0.12), 0.045),
        (shin, _box(knee, ankle, pad=0.11), 0.020),
        # Knee cap, then the two ankle bones.
        (
            lambda p: ellipsoid(p, offset(knee, 0.0, 0.008, 0.036), (0.026, 0.032, 0.022)),
            _box(knee, pad=0.07),
            0.025,
        ),
        (
            lambda p: ellipsoid(p, offset(ankle, -0.026, 0.006, 0.006), (0.013, 0.018, 0.016)),
            _box(ankle, pad=0.06),
            0.018,
        ),
        (
            lambda p: ellipsoid(p, offset(ankle, 0.026, -0.004, -0.004), (0.013, 0.018, 0.016)),
            _box(ankle, pad=0.06),
            0.018,
        ),
        (_foot_field, FOOT_BOX, 0.030),
    ]
    return legs


SOLE = -1.292
FOOT_BOX = np.array([[0.03, -1.31, -0.13], [0.21, -1.13, 0.19]])
_TOES = (
    # x and z of the base, x and z of the tip, radii of base and tip
    (0.090, 0.095, 0.086, 0.148, 0.0150, 0.0128),
    (0.112, 0.098, 0.111, 0.150, 0.0105, 0.0092),
    (0.128, 0.092, 0.130, 0.140, 0.0098, 0.0086),
    (0.143, 0.083, 0.147, 0.128, 0.0094, 0.0082),
    (0.157, 0.071, 0.163, 0.113, 0.0090, 0.0080),
)


def _foot_field(p: np.ndarray) -> np.ndarray:
    """Heel, instep, ball and five toes, cut flat at the sole and hollowed under the arch."""
    f = cone(p, (0.098, -1.245, -0.070), (0.098, -1.200, -0.050), 0.036, 0.036)
    heel = ellipsoid(p, (0.098, -1.262, -0.072), (0.033, 0.036, 0.036))
    f = smooth_min(f, heel, 0.02)
    f = smooth_min(f, cone(p, (0.098, -1.228, -0.020), (0.106, -1.262, 0.070), 0.036, 0.022), 0.025)
    outer = cone(p, (0.108, -1.266, -0.050), (0.145, -1.272, 0.068), 0.028, 0.019)
    f = smooth_min(f, outer, 0.03)
    ball = cone(p, (0.094, -1.271, 0.078), (0.150, -1.276, 0.058), 0.021, 0.016)
    f = smooth_min(f, ball, 0.025)
    toes = np.full(len(p), 1.0)
    for x0, z0, x1, z1, r0, r1 in _TOES:
        toe = cone(p, (x0, -1.274, z0), (x1, -1.2795, z1), r0, r1)
        toes = smooth_min(toes, toe, 0.003)
    f = smooth_min(f, toes, 0.014)
    arch = ellipsoid(p, (0.062, -1.300, 0.008), (0.036, 0.020, 0.055))
    f = carve(f, arch, 0.015)
    return carve(f, p[:, 1] - SOLE, 0.012)


def _arm() -> list[_Piece]:
    shoulder, elbow, wrist = (_joint(f"left_{n}") for n in ("shoulder", "elbow", "wrist"))
    upper = Sweep(
        shoulder,
        elbow - shoulder,
        (0, 0, 1),
        [
            # u is depth here, v is up: triceps hangs below, biceps lies in front and above.
            (-0.02, 0.000, 0.000, 0.046, 0.042, 0.050),
            (0.05, 0.000, 0.000, 0.0485, 0.047, 0.051),
            (0.10, 0.002, 0.000, 0.0475, 0.043, 0.049),
            (0.15, 0.003, 0.000, 0.0460, 0.042, 0.046),
            (0.20, 0.002, 0.000, 0.0420, 0.038, 0.041),
            (0.25, 0.000, 0.000, 0.0385, 0.036, 0.037),
            (0.28, 0.000, 0.000, 0.0370, 0.035, 0.035),
        ],
        caps=(0.04, 0.03),
    )
    fore = Sweep(
        elbow,
        wrist - elbow,
        (0, 0, 1),
        [
            (-0.02, 0.000, 0.000, 0.0365, 0.034, 0.034),
            (0.02, 0.002, 0.001, 0.0395, 0.0365, 0.035),
            (0.06, 0.003, 0.002, 0.0415, 0.0375, 0.036),
            (0.11, 0.002, 0.001, 0.0385, 0.035, 0.034),
            (0.17, 0.001, 0.000, 0.0330, 0.028, 0.028),
            (0.22, 0.000, 0.000, 0.0285, 0.0215, 0.0215),
            (0.25, 0.000, 0.000, 0.0275, 0.0190, 0.0190),
            (0.275, 0.000, 0.000, 0.0280, 0.0185, 0.0185),
        ],
        caps=(0.03, 0.02),
    )
    return [
        (upper, _box(shoulder, elbow, pad=0.07), 0.030),
        (fore, _box(elbow, wrist, pad=0.06), 0.018),
        (
            lambda p: ellipsoid(p, offset(elbow, 0.0, 0.0, -0.026), (0.018, 0.016, 0.014)),
            _box(elbow, pad=0.05),
            0.016,
        ),
    ]


class Person:
    """The implicit function of the whole person: negative inside."""

    def __init__(self) -> None:
        self._pieces: list[_Piece] = [*_trunk(), *_leg(), *_arm()]
        self._pieces.append((head_field, HEAD_BOX, 0.012))
        self._pieces.append((hand_field, HAND_BOX, 0.010))

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        p = np.array(points, dtype=np.float64)
        p[:, 0] = np.abs(p[:, 0])
        # A fillet instead of a crease where the two sides meet, between legs and at the sternum.
        rounded = p.copy()
        rounded[:, 0] = np.hypot(p[:, 0], _MIDLINE_FILLET)
        f = np.full(len(p), 0.5)
        for piece, box, fillet in self._pieces:
            gap = np.maximum(np.maximum(box[0] - p, p - box[1]), 0.0)
            near = np.flatnonzero((gap * gap).sum(1) < _REACH * _REACH)
            if near.size:
                own = p if piece in (head_field, hand_field) else rounded
                f[near] = smooth_min(f[near], piece(own[near]), fillet)
        return f
