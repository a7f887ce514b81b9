"""Ten shape directions, metres per unit coefficient.

Each direction lengthens bones (joints follow) and thickens the parts around them. The skinning
weights carry the change to the surface, so that skin and joints change together. Belly, chest and
hips are additional bumps.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from .field import bump
from .skeleton import (
    JOINT_INDEX,
    JOINT_NAMES,
    PARENTS,
    finger_chain,
    rest_joints,
)

SHAPE_NAMES = (
    "stature", "weight", "shoulder_width", "leg_length", "arm_length", "hips", "hand_size",
    "head_size", "chest_and_belly", "limb_girth",
)  # fmt: skip

_ARM = ("shoulder", "elbow")
_FOREARM_HAND = ("wrist", "index", "middle", "ring", "pinky", "thumb")
_LEG = ("hip", "knee")
_TRUNK = ("pelvis", "spine1", "spine2", "spine3")
_HEAD = ("head", "jaw", "eye")

# Relative growth along the bone and across it, by joint stem, per unit coefficient.
_LONG: tuple[Mapping[str, float], ...] = (
    {"": 0.036},
    {"collar": 0.045},
    {"collar": 0.085},
    {**dict.fromkeys(_LEG, 0.042), **dict.fromkeys(_TRUNK, -0.026)},
    dict.fromkeys((*_ARM,), 0.050),
    {"pelvis": -0.010, "spine1": 0.022, "spine2": 0.022},
    dict.fromkeys(_FOREARM_HAND, 0.060),
    {**dict.fromkeys(_HEAD, 0.035), "spine3": 0.020, "neck": 0.020},
    {"spine1": -0.022, "spine2": -0.022, "collar": -0.030},
    {"collar": 0.020},
)
_WIDE: tuple[Mapping[str, float], ...] = (
    {"": 0.030},
    {
        **dict.fromkeys(_TRUNK, 0.085),
        **dict.fromkeys((*_ARM, *_LEG), 0.080),
        "collar": 0.060, "neck": 0.050, "head": 0.012, "jaw": 0.020, "ankle": 0.015,
        "wrist": 0.012,
    },
    {"spine3": 0.040, "collar": 0.030, "shoulder": 0.020, "spine2": 0.012},
    {},
    {},
    {"pelvis": 0.070, "hip": 0.050, "spine1": 0.020},
    dict.fromkeys(_FOREARM_HAND, 0.060),
    dict.fromkeys(_HEAD, 0.035),
    {},
    {**dict.fromkeys((*_ARM, *_LEG), 0.075), "neck": 0.05, "spine2": -0.02, "spine1": -0.025},
)  # fmt: skip


def _rate(table: Mapping[str, float], joint: int) -> float:
    stem = JOINT_NAMES[joint].split("_")[-1].rstrip("123")
    if JOINT_NAMES[joint].startswith("spine"):
        stem = JOINT_NAMES[joint]
    return table.get(stem, table.get("", 0.0))


def bone_directions(joints: np.ndarray) -> np.ndarray:
    """Unit direction of the bone of each joint, (55, 3)."""
    towards = {
        "pelvis": "spine1", "hip": "knee", "knee": "ankle", "ankle": "foot", "spine1": "spine2",
        "spine2": "spine3", "spine3": "neck", "neck": "head", "collar": "shoulder",
        "shoulder": "elbow", "elbow": "wrist", "wrist": "middle1",
    }  # fmt: skip
    out = np.zeros_like(joints)
    for j, name in enumerate(JOINT_NAMES):
        side = name.split("_")[0] + "_" if "_" in name else ""
        stem = name[len(side) :]
        if stem in towards:
            target = towards[stem]
            out[j] = joints[JOINT_INDEX[side + target if side else target]] - joints[j]
        elif stem[-1:] in "123":
            chain = finger_chain(stem[:-1])
            i = int(stem[-1])
            out[j] = (chain[i] - chain[i - 1]) * np.array([1 if side == "left_" else -1, 1, 1])
        elif stem == "foot":
            out[j] = (0.0, 0.0, 1.0)
        else:
            out[j] = (0.0, 1.0, 0.0)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def _local(name: str, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Displacements of the surface that do not come from bones."""
    p = np.concatenate([np.abs(vertices[:, :1]), vertices[:, 1:]], 1)
    amount = np.zeros(len(p))
    if name == "weight":
        amount += 0.008 * bump(p, (0.0, -0.25, 0.06), (0.10, 0.09, 0.08))
    if name == "chest_and_belly":
        amount += 0.014 * bump(p, (0.0, -0.24, 0.08), (0.11, 0.085, 0.07))
        amount -= 0.008 * bump(p, (0.075, 0.0, 0.09), (0.06, 0.06, 0.06))
    if name == "hips":
        amount += 0.007 * bump(p, (0.08, -0.42, -0.09), (0.07, 0.07, 0.05))
    return amount[:, None] * normals


def shape_directions(
    vertices: Float[np.ndarray, "V 3"],
    normals: Float[np.ndarray, "V 3"],
    weights: Float[np.ndarray, "V 55"],
) -> tuple[Float[np.ndarray, "V 3 10"], Float[np.ndarray, "55 3 10"]]:
    """Displacement of vertices and of joints for every direction."""
    joints = rest_joints()
    bones = bone_directions(joints)
    vertex_dirs = np.zeros((len(vertices), 3, len(SHAPE_NAMES)))
    joint_dirs = np.zeros((len(joints), 3, len(SHAPE_NAMES)))
    for s, name in enumerate(SHAPE_NAMES):
        grow = np.zeros((len(joints), 3, 3))
        shift = np.zeros((len(joints), 3))
        for j in range(len(joints)):
            along = np.outer(bones[j], bones[j])
            grow[j] = _rate(_LONG[s], j) * along + _rate(_WIDE[s], j) * (np.eye(3) - along)
            if name in ("stature", "head_size", "hand_size"):
                grow[j] = _rate(_LONG[s], j) * np.eye(3)
            parent = PARENTS[j]
            if parent >= 0:
                # Joints move with the growth of their parent.
                shift[j] = shift[parent] + grow[parent] @ (joints[j] - joints[parent])
        joint_dirs[..., s] = shift
        moved = np.zeros_like(vertices)
        for j in range(len(joints)):
            moved += weights[:, j : j + 1] * ((vertices - joints[j]) @ grow[j].T + shift[j])
        vertex_dirs[..., s] = moved + _local(name, vertices, normals)
    return vertex_dirs, joint_dirs
