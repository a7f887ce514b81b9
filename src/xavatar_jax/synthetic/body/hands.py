"""Hand pose space: a relaxed mean and an orthonormal basis of plausible motions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .skeleton import FINGERS, finger_chain

_RELAXED = {
    "index": (0.30, 0.38, 0.22),
    "middle": (0.38, 0.45, 0.26),
    "ring": (0.44, 0.48, 0.28),
    "pinky": (0.48, 0.46, 0.28),
    "thumb": (0.10, 0.18, 0.22),
}


def flexion_axes(finger: str) -> Float[np.ndarray, "3 3"]:
    """Unit flexion axes of the joints of a left finger."""
    chain = finger_chain(finger)
    axes = []
    for i in range(3):
        along = chain[i + 1] - chain[i]
        along = along / np.linalg.norm(along)
        # The palmar side of a finger faces down; the thumb's faces backwards, across the palm.
        palm = np.array([0.0, -1.0, 0.0]) if finger != "thumb" else np.array([0.15, -0.55, -0.80])
        axis = np.cross(along, palm)
        axes.append(axis / np.linalg.norm(axis))
    return np.stack(axes)


def spread_axis(finger: str) -> Float[np.ndarray, " 3"]:
    """Axis of the rotation that moves the tip of a left finger towards the thumb."""
    chain = finger_chain(finger)
    along = chain[1] - chain[0]
    axis = np.cross(along, flexion_axes(finger)[0])
    return -axis / np.linalg.norm(axis)


def mirror_rotation(vector: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Axis-angle vectors mirrored in the plane x = 0."""
    return vector * np.array([1.0, -1.0, -1.0])


def relaxed_hand() -> Float[np.ndarray, " 45"]:
    """Axis-angle pose of the relaxed left hand, radians."""
    pose = [angle * axis for f in FINGERS
            for angle, axis in zip(_RELAXED[f], flexion_axes(f), strict=True)]  # fmt: skip
    return np.concatenate(pose)


def hand_basis() -> Float[np.ndarray, "45 45"]:
    """Orthonormal basis of left hand poses (rows), the most useful motions first."""
    rows = []

    def flex(profile: dict[str, tuple[float, float, float]]) -> None:
        row = np.zeros((len(FINGERS), 3, 3))
        for f, angles in profile.items():
            row[FINGERS.index(f)] = np.asarray(angles)[:, None] * flexion_axes(f)
        rows.append(row.ravel())

    four = ("index", "middle", "pinky", "ring")
    flex({**dict.fromkeys(four, (1.0, 1.2, 0.7)), "thumb": (0.3, 0.5, 0.6)})
    spread = np.zeros((len(FINGERS), 3, 3))
    for f, amount in zip(FINGERS, (0.6, 0.1, -1.0, -0.5, 0.9), strict=True):
        spread[FINGERS.index(f), 0] = amount * spread_axis(f)
    rows.append(spread.ravel())
    flex({"thumb": (1.0, 0.8, 0.8)})
    flex({"index": (1.0, 1.0, 0.6), "pinky": (-0.7, -0.7, -0.4), "ring": (-0.5, -0.5, -0.3)})
    flex(dict.fromkeys(four, (1.0, -0.8, -0.5)))
    for f in FINGERS:
        flex({f: (1.0, 0.6, 0.3)})
        flex({f: (0.0, 1.0, 0.6)})
    basis: list[np.ndarray] = []
    for row in [*rows, *np.eye(45)]:
        row = row.copy()
        for _ in range(2):
            for b in basis:
                row -= b * (b @ row)
        length = np.linalg.norm(row)
        if length > 1e-6 and len(basis) < 45:
            basis.append(row / length)
    return np.stack(basis)
