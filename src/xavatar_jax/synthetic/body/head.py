"""The head's implicit surface: skull, face, lips and mouth, eyes with lids, ears, hair."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float

from .field import (
    Sweep,
    carve,
    cone,
    ellipsoid,
    offset,
    smooth_max,
    smooth_min,
    sphere,
)

HEAD_BOX = np.array([[0.0, 0.195, -0.13], [0.11, 0.47, 0.13]])

EYE = np.array([0.032, 0.334, 0.0635])
EYE_RADIUS = 0.0125
LID_RADIUS = 0.0143
MOUTH = np.array([0.0, 0.2665, 0.086])
MOUTH_HALF_WIDTH = 0.0235
NOSE_TIP = np.array([0.0, 0.2970, 0.0990])


def mouth_line(x: np.ndarray) -> np.ndarray:
    """Height of the line between the lips: slightly lower in the middle."""
    return MOUTH[1] - 0.0012 * np.cos(np.clip(x / MOUTH_HALF_WIDTH, -1, 1) * np.pi)


def lid_opening(p: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Negative inside the opening between the lids, seen from the front (symmetric in x)."""
    x = np.abs(p[:, 0]) - EYE[0]
    y = p[:, 1] - EYE[1] - 0.06 * x
    # Two arcs through the corners of the eye.
    width, top, bottom = 0.0140, 0.0054, 0.0046
    r_top = (width**2 + top**2) / (2 * top)
    r_bottom = (width**2 + bottom**2) / (2 * bottom)
    upper = np.hypot(x, y - (top - r_top)) - r_top
    lower = np.hypot(x, y + (bottom - r_bottom)) - r_bottom
    return np.maximum(upper, lower)


@cache
def _face() -> Sweep:
    return Sweep(
        (0, 0, 0),
        (0, 1, 0),
        (1, 0, 0),
        # y, half width, front z, back z
        [
            (y, 0.0, 0.5 * (front + back), width, *(2 * [0.5 * (front - back)]))
            for y, width, front, back in [
                (0.224, 0.0270, 0.0760, 0.010),
                (0.238, 0.0385, 0.0815, 0.000),
                (0.252, 0.0470, 0.0820, -0.010),
                (0.268, 0.0545, 0.0850, -0.020),
                (0.286, 0.0605, 0.0845, -0.030),
                (0.310, 0.0655, 0.0815, -0.040),
                (0.335, 0.0680, 0.0800, -0.050),
                (0.360, 0.0670, 0.0845, -0.050),
                (0.385, 0.0600, 0.0800, -0.040),
            ]
        ],
        caps=(0.012, 0.03),
        squareness=2.2,
    )


def head_field(p: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Head without the neck, for points with x >= 0."""
    skull = ellipsoid(p, (0.0, 0.353, -0.006), (0.0755, 0.084, 0.0965))
    f = smooth_min(skull, _face()(p), 0.020)
    # Jaw from the chin to the angle below the ear, cheek bone, chin.
    jaw = cone(p, (0.011, 0.2275, 0.066), (0.0435, 0.2590, 0.002), 0.0125, 0.0120)
    f = smooth_min(f, jaw, 0.022)
    f = smooth_min(f, ellipsoid(p, (0.0, 0.2275, 0.0755), (0.0160, 0.0120, 0.0115)), 0.014)
    f = smooth_min(f, ellipsoid(p, (0.046, 0.306, 0.052), (0.018, 0.013, 0.016)), 0.020)
    brow = cone(p, (0.010, 0.3530, 0.0795), (0.044, 0.3545, 0.0640), 0.0070, 0.0065)
    f = smooth_min(f, brow, 0.014)
    socket = ellipsoid(p, offset(EYE, -0.001, 0.0, 0.0265), (0.0185, 0.0125, 0.0145))
    f = carve(f, socket, 0.012)

    # Nose: bridge, tip, wings; nostrils are shallow dents from below.
    nose = cone(p, (0.0, 0.344, 0.0765), offset(NOSE_TIP, 0.0, 0.002, -0.0015), 0.0068, 0.0078)
    nose = smooth_min(nose, sphere(p, NOSE_TIP, 0.0086), 0.006)
    # The body of the nose below the bridge, back to the face.
    bulk = cone(p, (0.0, 0.330, 0.0745), (0.0, 0.2960, 0.0850), 0.0085, 0.0112)
    nose = smooth_min(nose, bulk, 0.008)
    wing = ellipsoid(p, (0.0112, 0.2920, 0.0860), (0.0068, 0.0064, 0.0100))
    nose = smooth_min(nose, wing, 0.007)
    f = smooth_min(f, nose, 0.008)
    nostril = ellipsoid(p, (0.0060, 0.2850, 0.0915), (0.0032, 0.0042, 0.0052))
    f = carve(f, nostril, 0.003)

    # Eyeball, then lids: a shell around it with an almond-shaped opening.
    lids = carve(sphere(p, EYE, LID_RADIUS), lid_opening(p), 0.0016)
    lids = smooth_max(lids, EYE[2] - 0.004 - p[:, 2], 0.004)
    f = smooth_min(f, lids, 0.006)
    # The opening is also cut through the face, down to the eyeball.
    window = np.maximum(lid_opening(p), EYE[2] - p[:, 2])
    f = carve(f, window, 0.0022)
    f = smooth_min(f, sphere(p, EYE, EYE_RADIUS), 0.0014)

    f = _mouth(p, f)
    f = _ear(p, f)
    return _hair(p, f)


def _mouth(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    upper = cone(p, (0.0045, 0.2716, 0.0853), (0.0238, 0.2674, 0.0765), 0.0047, 0.0028)
    lower = cone(p, (0.0, 0.2612, 0.0842), (0.0218, 0.2656, 0.0762), 0.0054, 0.0034)
    f = smooth_min(f, upper, 0.005)
    f = smooth_min(f, lower, 0.005)
    philtrum = cone(p, (0.0, 0.2785, 0.0915), (0.0, 0.2850, 0.0915), 0.0026, 0.0020)
    f = carve(f, philtrum, 0.006)
    # The slit follows the lips; behind them it opens into a small pocket.
    q = p.copy()
    q[:, 1] -= mouth_line(p[:, 0]) - MOUTH[1]
    q[:, 2] += 6.0 * p[:, 0] ** 2
    slit = ellipsoid(q, MOUTH, (MOUTH_HALF_WIDTH, 0.0010, 0.024))
    pocket = ellipsoid(q, offset(MOUTH, 0.0, 0.0, -0.021), (0.020, 0.0055, 0.012))
    return carve(f, smooth_min(slit, pocket, 0.004), 0.0016)


def _ear(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    centre = np.array([0.0775, 0.318, -0.012])
    # The ear's plane leans back and stands off the skull.
    up = np.array([0.12, 0.97, -0.20])
    up = up / np.linalg.norm(up)
    out = np.array([0.90, -0.05, 0.42])
    out = out - up * (out @ up)
    out = out / np.linalg.norm(out)
    axes = np.stack([out, up, np.cross(out, up)])
    ear = ellipsoid(p, centre, (0.0058, 0.0300, 0.0175), axes)
    lobe = ellipsoid(p, centre - 0.022 * up + (-0.002, 0.0, 0.004), (0.005, 0.011, 0.009), axes)
    ear = smooth_min(ear, lobe, 0.006)
    shell = centre + 0.0065 * out + 0.003 * up
    bowl = ellipsoid(p, offset(shell, 0.0, 0.0, 0.002), (0.0062, 0.0195, 0.0105), axes)
    ear = carve(ear, bowl, 0.003)
    return smooth_min(f, ear, 0.007)


def hair_edge(p: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Negative where hair grows: above the hairline, behind the temples and ears."""
    y, z = p[:, 1], p[:, 2]
    x = np.abs(p[:, 0])
    front = 0.389 + 0.35 * (0.085 - z) - 3.0 * x * x
    front = front + 0.010 * np.exp(-(((x - 0.043) / 0.017) ** 2))
    # Down the temple to the sideburn, round the ear, and along the nape.
    temple = 0.402 - 0.069 * _step((0.050 - z) / 0.030)
    temple = temple - 0.010 * _step((0.014 - z) / 0.010)
    nape = 0.3065 - 0.040 * _step((-0.018 - z) / 0.035)
    line = np.where(z > -0.010, np.minimum(front, temple), nape)
    return line - y


def _step(t: np.ndarray) -> np.ndarray:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _hair(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    cap = ellipsoid(p, (0.0, 0.360, -0.010), (0.0800, 0.0880, 0.1010))
    hair = smooth_max(cap, 0.9 * hair_edge(p), 0.006)
    return smooth_min(f, hair, 0.003)
