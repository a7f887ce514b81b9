"""Ranges of the axis-angle components of human joints, in degrees.

All joint frames are aligned with the world at rest (T-pose, palms down, facing +Z, left at +X).
Ranges follow clinical range-of-motion norms for healthy adults (Norkin and White, Measurement of
Joint Motion), written for the left side; the right side is its mirror image.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

Range = tuple[float | int, float | int]

# (x, y, z): on the midline x is bending forwards, y turning left, z leaning to the right.
_MIDLINE: dict[str, tuple[Range, Range, Range]] = {
    "spine1": ((-12, 30), (-15, 15), (-15, 15)),
    "spine2": ((-12, 30), (-15, 15), (-15, 15)),
    "spine3": ((-12, 30), (-15, 15), (-15, 15)),
    "neck": ((-30, 30), (-40, 40), (-22, 22)),
    "head": ((-35, 35), (-45, 45), (-25, 25)),
    "jaw": ((-2, 28), (-8, 8), (-4, 4)),
}

_LEFT: dict[str, tuple[Range, Range, Range]] = {
    # Thigh: x negative is flexion, z positive abduction.
    "hip": ((-125, 30), (-50, 50), (-30, 55)),
    "knee": ((-3, 150), (-15, 15), (-15, 15)),
    "ankle": ((-35, 55), (-35, 35), (-25, 25)),
    "foot": ((-65, 40), (-5, 5), (-5, 5)),
    "collar": ((-15, 15), (-30, 20), (-20, 40)),
    # Upper arm from the T-pose: y negative forwards, z negative down to the side.
    "shoulder": ((-105, 105), (-150, 75), (-110, 100)),
    # Elbow: y negative is flexion, x the forearm's share of the palm's rotation; both together
    # have a z component.
    "elbow": ((-50, 50), (-155, 8), (-40, 40)),
    # Wrist: z negative is flexion (towards the palm), y deviation, x the rest of the rotation.
    "wrist": ((-55, 55), (-38, 38), (-80, 75)),
    "eye": ((-30, 30), (-38, 38), (-5, 5)),
}

# Fingers in their own axes: flexion, spread and twist of knuckle, middle and last joint.
_FINGER: dict[str, tuple[Range, Range, Range]] = {
    "1": ((-30, 95), (-28, 28), (-12, 12)),
    "2": ((-8, 118), (-6, 6), (-6, 6)),
    "3": ((-12, 90), (-6, 6), (-6, 6)),
}
_THUMB: dict[str, tuple[Range, Range, Range]] = {
    "1": ((-65, 65), (-65, 65), (-65, 65)),
    "2": ((-65, 65), (-65, 65), (-65, 65)),
    "3": ((-85, 85), (-85, 85), (-85, 85)),
}


def _hand(side: str) -> dict[str, tuple[Range, Range, Range]]:
    ranges = {}
    for finger in ("index", "middle", "pinky", "ring"):
        for k, (bend, spread, twist) in _FINGER.items():
            # Fingers point along x: flexion is about -z, spread about y, twist about x. A
            # knuckle's axis is oblique by up to 12 degrees, hence the tolerance in x.
            slant = max(abs(bend[0]), abs(bend[1])) * 0.21
            ranges[f"{side}_{finger}{k}"] = (
                (twist[0] - slant, twist[1] + slant),
                spread,
                (-bend[1], -bend[0]),
            )
    ranges |= {f"{side}_thumb{k}": limits for k, limits in _THUMB.items()}
    return ranges


def _mirrored(limits: tuple[Range, Range, Range]) -> tuple[Range, Range, Range]:
    x, y, z = limits
    return x, (-y[1], -y[0]), (-z[1], -z[0])


def _all() -> dict[str, tuple[Range, Range, Range]]:
    left = {f"left_{name}": limits for name, limits in _LEFT.items()} | _hand("left")
    right = {name.replace("left", "right", 1): _mirrored(limits) for name, limits in left.items()}
    return {**_MIDLINE, **left, **right}


JOINT_LIMITS_DEG: dict[str, tuple[Range, Range, Range]] = _all()


def joint_limits(
    names: Sequence[str],
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, "J 3"]]:
    """Smallest and largest axis-angle components of joints, radians; infinite for the root."""
    free = ((-np.inf, np.inf),) * 3
    table = np.array([JOINT_LIMITS_DEG.get(name, free) for name in names])
    return np.deg2rad(table[..., 0]), np.deg2rad(table[..., 1])
