"""Ten expression directions: smooth displacements at facial landmarks, metres per unit.

Displacements of a lip are weighted by the skinning weight of the jaw, so that the upper and lower
lip, two millimetres apart, move separately.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .field import bump
from .skeleton import JOINT_INDEX

EXPRESSION_NAMES = (
    "smile", "mouth_open", "brow_raise", "brow_frown", "pout", "cheek_puff", "mouth_wide",
    "nose_wrinkle", "eye_squint", "smirk",
)  # fmt: skip

_MM = 1e-3
_CORNER = (0.0235, 0.2665, 0.0765)

# name -> displacements: (centre, radii, millimetres, lip, side). lip: "u" upper only, "l" lower
# only, "" both; side: 0 mirrored to both sides, 1 left side only.
_PUSHES: dict[str, list[tuple]] = {
    "smile": [
        (_CORNER, (0.011, 0.010, 0.016), (3.6, 4.2, -2.6), "", 0),
        ((0.0, 0.2665, 0.086), (0.014, 0.012, 0.018), (0.0, -0.2, -1.0), "", 0),
        ((0.043, 0.298, 0.062), (0.015, 0.012, 0.014), (0.8, 2.4, 1.6), "", 0),
        ((0.032, 0.324, 0.074), (0.014, 0.006, 0.010), (0.0, 0.7, 0.0), "", 0),
    ],
    "mouth_open": [
        ((0.0, 0.2580, 0.084), (0.018, 0.014, 0.022), (0.0, -4.6, -0.6), "l", 0),
        ((0.0, 0.2330, 0.078), (0.026, 0.016, 0.022), (0.0, -3.6, -0.8), "l", 0),
        ((0.0, 0.2730, 0.087), (0.014, 0.009, 0.014), (0.0, 0.9, 0.2), "u", 0),
    ],
    "brow_raise": [
        ((0.030, 0.3590, 0.074), (0.020, 0.010, 0.018), (0.0, 4.6, 0.2), "", 0),
        ((0.020, 0.3740, 0.080), (0.026, 0.010, 0.018), (0.0, 1.8, 0.4), "", 0),
        ((0.032, 0.3430, 0.074), (0.014, 0.005, 0.010), (0.0, 1.3, 0.0), "", 0),
    ],
    "brow_frown": [
        ((0.016, 0.3560, 0.079), (0.011, 0.009, 0.014), (-2.0, -3.0, 0.8), "", 0),
        ((0.0, 0.3550, 0.083), (0.009, 0.010, 0.012), (0.0, -1.0, 1.2), "", 0),
        ((0.044, 0.3570, 0.066), (0.012, 0.009, 0.014), (0.0, 0.8, 0.0), "", 0),
    ],
    "pout": [
        ((0.0, 0.2600, 0.087), (0.014, 0.010, 0.015), (0.0, 0.3, 4.2), "l", 0),
        ((0.0, 0.2730, 0.088), (0.014, 0.009, 0.015), (0.0, -0.2, 3.6), "u", 0),
        (_CORNER, (0.011, 0.010, 0.014), (-4.0, 0.0, 2.0), "", 0),
        ((0.0, 0.2400, 0.082), (0.016, 0.010, 0.014), (0.0, 1.0, 0.6), "l", 0),
    ],
    "cheek_puff": [
        ((0.042, 0.2740, 0.056), (0.015, 0.017, 0.020), (4.6, 0.0, 2.6), "", 0),
        ((0.0, 0.2790, 0.088), (0.014, 0.007, 0.012), (0.0, 0.0, 1.2), "u", 0),
    ],
    "mouth_wide": [
        (_CORNER, (0.012, 0.011, 0.016), (4.8, -0.4, -2.8), "", 0),
        ((0.0, 0.2665, 0.086), (0.016, 0.012, 0.016), (0.0, 0.0, -1.2), "", 0),
        ((0.038, 0.2620, 0.058), (0.012, 0.014, 0.014), (1.6, 0.0, 0.4), "", 0),
    ],
    "nose_wrinkle": [
        ((0.0125, 0.2925, 0.092), (0.008, 0.008, 0.012), (1.4, 2.8, 0.0), "", 0),
        ((0.006, 0.3250, 0.086), (0.010, 0.012, 0.012), (0.0, 1.2, 0.9), "", 0),
        ((0.010, 0.2740, 0.086), (0.010, 0.008, 0.012), (0.2, 2.0, 0.4), "u", 0),
        ((0.014, 0.3540, 0.078), (0.012, 0.008, 0.012), (-0.6, -1.6, 0.4), "", 0),
    ],
    "eye_squint": [
        ((0.033, 0.3235, 0.074), (0.014, 0.0060, 0.010), (0.0, 2.0, 0.5), "", 0),
        ((0.033, 0.3445, 0.074), (0.014, 0.0060, 0.010), (0.0, -2.0, 0.4), "", 0),
        ((0.045, 0.3040, 0.060), (0.014, 0.012, 0.014), (0.0, 1.8, 0.8), "", 0),
    ],
    "smirk": [
        (_CORNER, (0.011, 0.010, 0.016), (3.4, 4.4, -2.2), "", 1),
        ((0.043, 0.298, 0.062), (0.015, 0.012, 0.014), (0.8, 2.6, 1.4), "", 1),
        ((0.030, 0.3590, 0.074), (0.018, 0.010, 0.016), (0.0, 2.4, 0.2), "", 1),
    ],
}


def expression_directions(
    vertices: Float[np.ndarray, "V 3"], weights: Float[np.ndarray, "V 55"]
) -> Float[np.ndarray, "V 3 10"]:
    """Displacement of every vertex for each expression."""
    jaw = weights[:, JOINT_INDEX["jaw"]]
    eye = weights[:, JOINT_INDEX["left_eye"]] + weights[:, JOINT_INDEX["right_eye"]]
    head = np.clip((vertices[:, 2] - 0.012) / 0.03, 0.0, 1.0)
    # Only skin that follows head or jaw; the eyeballs stay.
    head = head * head * (3.0 - 2.0 * head)
    head *= (weights[:, JOINT_INDEX["head"]] + jaw + eye) * (1.0 - eye)
    out = np.zeros((len(vertices), 3, len(EXPRESSION_NAMES)))
    for e, name in enumerate(EXPRESSION_NAMES):
        for centre, radii, push, lip, side in _PUSHES[name]:
            mask = head * {"u": 1.0 - jaw, "l": jaw, "": 1.0}[lip]
            for sign in (1.0, -1.0):
                if sign < 0.0 and side:
                    continue
                flip = np.array([sign, 1.0, 1.0])
                fall = bump(vertices, np.asarray(centre) * flip, radii)
                if centre[0] == 0.0:
                    fall *= 0.5  # both mirror images coincide on the midline
                out[:, :, e] += (mask * fall)[:, None] * (np.asarray(push) * flip * _MM)
    out[np.abs(out) < 2e-6] = 0.0
    return out
