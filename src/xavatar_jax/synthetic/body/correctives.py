"""Pose correctives: muscles and knuckles that swell when joints bend.

SMPL-style correctives are linear in the entries of R - I of every joint. For a bone along the
unit vector b, -b.(R - I)b = 1 - cos(swing): one combination of entries that measures the swing in
any direction and ignores twist. It drives smooth bumps along the normals around each joint; at
90 degrees a bump has its stated height.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .field import bump
from .shape import bone_directions
from .skeleton import (
    FINGERS,
    JOINT_INDEX,
    JOINT_NAMES,
    finger_chain,
    mirrored_joint,
    rest_joints,
)

_MM = 1e-3
# Maximum height of a bump at 90 degrees; at 30 degrees it is 13 % of that, under 1 mm.
_MOST = 7.0 * _MM

# Joint -> (centre relative to the joint, radius along each axis, height in mm), left side.
_BUMPS: dict[str, list[tuple[tuple, tuple, float]]] = {
    "left_elbow": [
        ((-0.130, 0.010, 0.045), (0.050, 0.030, 0.030), 5.0),  # biceps
        ((0.000, 0.000, -0.038), (0.026, 0.026, 0.018), 5.0),  # point of the elbow
        ((0.055, 0.010, 0.040), (0.035, 0.028, 0.025), 3.0),  # forearm flexors
    ],
    "left_knee": [
        ((0.000, 0.000, 0.055), (0.035, 0.040, 0.025), 5.0),  # knee cap
        ((0.000, -0.110, -0.065), (0.040, 0.060, 0.030), 4.0),  # calf
        ((0.000, 0.130, -0.065), (0.040, 0.060, 0.030), 3.5),  # hamstrings
    ],
    "left_shoulder": [
        ((0.015, 0.050, 0.000), (0.045, 0.030, 0.045), 6.0),  # deltoid
        ((-0.080, -0.080, 0.110), (0.060, 0.050, 0.035), 3.0),  # pectoral
        ((-0.060, -0.040, -0.080), (0.060, 0.060, 0.035), 2.5),  # shoulder blade
    ],
    "left_hip": [
        ((0.010, 0.000, -0.115), (0.060, 0.060, 0.045), 6.0),  # buttock
        ((0.080, 0.030, 0.000), (0.035, 0.060, 0.050), 3.0),  # outer hip
    ],
    "left_ankle": [((0.000, 0.010, -0.045), (0.025, 0.035, 0.025), 2.5)],
    "left_wrist": [((0.000, 0.020, 0.000), (0.018, 0.012, 0.028), 2.0)],
    "spine1": [((0.000, 0.000, 0.110), (0.090, 0.070, 0.050), 3.0)],
    "spine2": [((0.000, -0.050, 0.120), (0.090, 0.060, 0.050), 2.5)],
    "neck": [((0.000, 0.030, -0.060), (0.040, 0.035, 0.030), 2.5)],
    "jaw": [((0.050, -0.030, 0.040), (0.015, 0.025, 0.025), -2.0)],
}


def _finger_bumps() -> dict[str, list[tuple[tuple, tuple, float]]]:
    bumps = {}
    for finger in FINGERS:
        chain = finger_chain(finger)
        for i in range(3):
            along = chain[i + 1] - chain[i]
            back = np.array([0.0, 1.0, 0.0]) if finger != "thumb" else np.array([0.1, 0.55, 0.5])
            along = along / np.linalg.norm(along)
            back = back - along * (along @ back)
            back = back / np.linalg.norm(back)
            height = (1.6, 1.3, 0.9)[i]
            pad = tuple(-0.007 * back + 0.012 * along)
            bumps[f"left_{finger}{i + 1}"] = [
                (tuple(0.009 * back), (0.007, 0.006, 0.007), height),
                (pad, (0.006, 0.005, 0.006), 0.6 * height),
            ]
    return bumps


def pose_directions(
    vertices: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3 486"]:
    """Displacements, linear in the flattened R_j - I of joints 1 to 54 (row-major, float32)."""
    joints = rest_joints()
    bones = bone_directions(joints)
    out = np.zeros((len(vertices), 3, 54, 9), dtype=np.float32)
    flip = np.array([-1.0, 1.0, 1.0])
    for name, bumps in {**_BUMPS, **_finger_bumps()}.items():
        left = JOINT_INDEX[name]
        for joint in {left, mirrored_joint(left)}:
            side = flip if JOINT_NAMES[joint].startswith("right_") else np.ones(3)
            height = np.zeros(len(vertices))
            for offset, radii, size in bumps:
                ends = [side] if joint != left or name.startswith("left_") else [side, flip]
                if offset[0] == 0.0:
                    ends = ends[:1]
                for end in ends:
                    centre = joints[joint] + np.asarray(offset) * end
                    height += size * _MM * bump(vertices, centre, radii)
            height = np.clip(height, -_MOST, _MOST)
            height[np.abs(height) < 0.02 * _MM] = 0.0
            touched = np.flatnonzero(height)
            swing = -np.outer(bones[joint], bones[joint]).ravel()
            push = height[touched, None] * normals[touched]
            out[touched, :, joint - 1] = push[:, :, None] * swing
    return out.reshape(len(vertices), 3, 486)
