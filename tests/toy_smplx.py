"""A body of capsules on the SMPL-X tree, in the SMPL-X file layout: small, quick, and rigid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from xavatar_jax.body import SMPLX_TREE
from xavatar_jax.synthetic.body.skeleton import rest_joints

HAND_MEAN_DEG = 9.0


def _tip(name: str, joint: np.ndarray, parent: np.ndarray) -> np.ndarray | None:
    if name == "head":
        return joint + np.array([0.0, 0.12, 0.02])
    if name.endswith("_foot"):
        return joint + np.array([0.0, -0.01, 0.06])
    if name[-1] == "3" and name != "spine3":
        return joint + 0.018 * (joint - parent) / np.linalg.norm(joint - parent)
    return None


def _radius(name: str) -> float:
    if name[-1] in "123" and "spine" not in name:
        return 0.009 if "thumb" not in name else 0.011
    thick = {"spine": 0.11, "pelvis": 0.11, "head": 0.09, "neck": 0.05, "hip": 0.075, "knee": 0.05}
    for part, radius in thick.items():
        if part in name:
            return radius
    return 0.036


def toy_arrays(seed: int = 0) -> dict[str, np.ndarray]:
    """The arrays of an SMPL-X `.npz`; shape directions scale the body about the pelvis."""
    joints, tree = rest_joints(), SMPLX_TREE
    rng = np.random.default_rng(seed)
    vertices, faces, owner, regress = [], [], [], []
    for j, name in enumerate(tree.names):
        ends = [(joints[j], joints[k]) for k in tree.children(j)]
        tip = _tip(name, joints[j], joints[tree.parents[j]])
        ends += [] if tip is None else [(joints[j], tip)]
        ends = ends or [(joints[j], joints[j] + (0.0, 0.0, 0.01))]
        first = sum(map(len, vertices))
        for start, end in ends:
            length = np.linalg.norm(end - start)
            wrist = name.endswith("wrist")
            radius = 0.012 if wrist else min(_radius(name), max(0.5 * length, 0.008))
            capsule = trimesh.creation.capsule(height=length, radius=radius, count=(6, 6))
            turn = trimesh.geometry.align_vectors((0, 0, 1), (end - start) / length)
            faces.append(capsule.faces + sum(map(len, vertices)))
            vertices.append(capsule.vertices @ turn[:3, :3].T + start)
            owner.append(np.full(len(capsule.vertices), j))
        # The first capsule's near cap is symmetric about the joint only as a whole: pin the joint
        # by two vertices added at its place.
        vertices.append(np.repeat(joints[j][None], 2, 0))
        owner.append(np.full(2, j))
        regress.append((j, sum(map(len, vertices)) - 1))
        del first
    vertices, owner = np.concatenate(vertices), np.concatenate(owner)
    faces = np.concatenate(faces)
    count = len(vertices)
    regressor = np.zeros((tree.num_joints, count))
    for j, vertex in regress:
        regressor[j, vertex] = 1.0
    weights = np.zeros((count, tree.num_joints))
    weights[np.arange(count), owner] = 1.0
    shapedirs = np.zeros((count, 3, 400), np.float32)
    centre = vertices - joints[0]
    for column in range(10):
        shapedirs[:, :, column] = 0.02 * centre @ rng.normal(size=(3, 3)) + 0.004 * rng.normal(3)
    head = owner == tree.index("jaw")
    shapedirs[head, 1, 300:310] = 0.001 * np.arange(1, 11)
    return {
        "v_template": vertices.astype(np.float32),
        "f": faces.astype(np.uint32),
        "weights": weights.astype(np.float32),
        "J_regressor": regressor.astype(np.float32),
        "shapedirs": shapedirs,
        "posedirs": (1e-4 * rng.normal(size=(count, 3, 486))).astype(np.float32),
        "kintree_table": np.stack([np.array(tree.parents), np.arange(55)]).astype(np.int64),
        "hands_meanl": np.deg2rad(HAND_MEAN_DEG) * np.tile([0.0, 0.0, -1.0], 15),
        "hands_meanr": np.deg2rad(HAND_MEAN_DEG) * np.tile([0.0, 0.0, 1.0], 15),
        "hands_componentsl": np.eye(45),
        "hands_componentsr": np.eye(45),
    }


def write_toy_body(path: Path) -> Path:
    np.savez(path, **toy_arrays())
    return path
