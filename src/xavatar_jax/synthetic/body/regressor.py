"""Joint regressor: each joint as a convex mean of vertices around it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .skeleton import JOINT_NAMES, rest_joints

# Initial search radius around a joint, metres.
_REACH = {
    "index": 0.014, "middle": 0.014, "ring": 0.014, "pinky": 0.013, "thumb": 0.020,
    "wrist": 0.035, "elbow": 0.055, "shoulder": 0.075, "knee": 0.070, "ankle": 0.060,
    "foot": 0.050, "eye": 0.085, "jaw": 0.085, "head": 0.095, "neck": 0.075,
}  # fmt: skip
_MAX_VERTICES = 48


def _reach(name: str) -> float:
    stem = name.split("_")[-1].rstrip("123")
    return _REACH.get(stem, 0.16)


def joint_regressor(
    vertices: Float[np.ndarray, "V 3"],
    avoid: Float[np.ndarray, " V"],
    shape_dirs: Float[np.ndarray, "V 3 S"],
    joint_dirs: Float[np.ndarray, "55 3 S"],
) -> Float[np.ndarray, "55 V"]:
    """Rows are non-negative, sum to one and reproduce the rest joints.

    Vertices with `avoid` above zero, which move with expressions, are not used. Among the possible
    rows, the one is chosen that also reproduces `joint_dirs` (the joint motion with shape) and
    involves many vertices.
    """
    from scipy.optimize import nnls

    joints = rest_joints()
    rows = np.zeros((len(joints), len(vertices)))
    for j, name in enumerate(JOINT_NAMES):
        distance = np.linalg.norm(vertices - joints[j], axis=1)
        distance = np.where(avoid > 0.0, np.inf, distance)
        reach = _reach(name)
        for _ in range(8):
            near = np.flatnonzero(distance < reach)
            if len(near) > _MAX_VERTICES:
                near = near[_spread(vertices[near], joints[j], _MAX_VERTICES)]
            if len(near) >= 8:
                row = _solve(nnls, vertices[near], shape_dirs[near], joints[j], joint_dirs[j])
                # A joint close to the hull of its vertices would depend on only two or three.
                if np.abs(row @ vertices[near] - joints[j]).max() < 2e-4 and row.max() < 0.2:
                    break
            reach *= 1.25
        else:
            raise RuntimeError(f"no convex combination of vertices reaches joint {name}")
        rows[j, near] = row
    return rows


def _spread(points: np.ndarray, centre: np.ndarray, count: int) -> np.ndarray:
    """Farthest-point sampling of directions around the centre, so that they enclose it."""
    direction = points - centre
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    chosen = [0]
    gap = ((direction - direction[0]) ** 2).sum(1)
    for _ in range(count - 1):
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, ((direction - direction[chosen[-1]]) ** 2).sum(1))
    return np.asarray(sorted(set(chosen)))


def _solve(nnls, points, dirs, joint, joint_dir) -> np.ndarray:
    n = len(points)
    follow = dirs.reshape(n, -1).T
    system = np.concatenate(
        [
            100.0 * np.ones((1, n)),
            5000.0 * (points - joint).T,
            200.0 * follow,
            1.5 * np.eye(n),
        ]
    )
    right = np.concatenate([[100.0], np.zeros(3), 200.0 * joint_dir.ravel(), np.full(n, 1.5 / n)])
    row, _ = nnls(system, right, maxiter=50 * n)
    return row / row.sum()
