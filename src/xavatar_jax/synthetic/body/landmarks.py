"""Face landmarks as in SMPL-X: 51 fixed points, and 17 on the contour for each yaw."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from .head import EYE, MOUTH


def _fixed_points() -> np.ndarray:
    """The 51 inner points of the 68-point markup, the person's right side first."""
    brow = [
        (x, 0.357 + y, 0.085)
        for x, y in ((0.052, -0.004), (0.042, 0.0), (0.032, 0.001), (0.022, 0.0), (0.012, -0.001))
    ]
    bridge = [(0.0, 0.336, 0.09), (0.0, 0.323, 0.097), (0.0, 0.310, 0.105), (0.0, 0.298, 0.118)]
    base = [(-0.0135, 0.286, 0.095), (-0.007, 0.2845, 0.102), (0.0, 0.284, 0.106)]
    base += [(0.007, 0.2845, 0.102), (0.0135, 0.286, 0.095)]
    lid = [(0.014, 0.0008), (0.005, 0.0048), (-0.005, 0.0048), (-0.0135, -0.0008),
           (-0.005, -0.0042), (0.005, -0.0042)]  # fmt: skip
    right_eye = [(-(EYE[0] + dx), EYE[1] + dy, 0.080) for dx, dy in lid]
    left_order = (3, 2, 1, 0, 5, 4)
    left_eye = [(EYE[0] + lid[i][0], EYE[1] + lid[i][1], 0.080) for i in left_order]
    m = MOUTH[1]
    upper = [(-0.024, m), (-0.015, m + 0.005), (-0.005, m + 0.0072), (0.0, m + 0.0066),
             (0.005, m + 0.0072), (0.015, m + 0.005), (0.024, m)]  # fmt: skip
    lower = [(0.015, m - 0.0075), (0.005, m - 0.0095), (0.0, m - 0.0098), (-0.005, m - 0.0095),
             (-0.015, m - 0.0075)]  # fmt: skip
    inner = [(-0.0215, m), (-0.006, m + 0.0012), (0.0, m + 0.001), (0.006, m + 0.0012),
             (0.0215, m), (0.006, m - 0.003), (0.0, m - 0.003), (-0.006, m - 0.003)]  # fmt: skip
    lips = [(x, y, 0.093 - 22 * x * x) for x, y in [*upper, *lower]]
    inside = [(x, y, 0.089 - 22 * x * x) for x, y in inner]
    right_brow = [(-x, y, z - 8 * x * x) for x, y, z in brow]
    left_brow = [(x, y, z - 8 * x * x) for x, y, z in brow[::-1]]
    return np.array(
        [*right_brow, *left_brow, *bridge, *base, *right_eye, *left_eye, *lips, *inside]
    )


def _contour_points(yaw: float) -> np.ndarray:
    """17 contour points for a camera rotated by `yaw` radians, right to left."""
    s = np.linspace(-1.0, 1.0, 17)
    x = 0.070 * np.sin(s * np.pi / 2)
    y = 0.222 + 0.100 * np.abs(s) ** 1.8
    z = 0.080 - 0.075 * np.abs(s) ** 1.3
    # The visible contour moves over the cheeks as the head turns.
    c, d = np.cos(0.6 * yaw), np.sin(0.6 * yaw)
    return np.stack([c * x + d * z, y, c * z - d * x], 1)


def _embed(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    import igl

    _, found, nearest = igl.point_mesh_squared_distance(points, vertices, faces.astype(np.int64))
    face = np.asarray(found)
    a, b, c = (vertices[faces[face, i]] for i in range(3))
    bary = np.clip(np.asarray(igl.barycentric_coordinates(nearest, a, b, c)), 0.0, None)
    return np.asarray(face, dtype=np.int64), bary / bary.sum(1, keepdims=True)


def landmarks(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> dict[str, np.ndarray]:
    """The four landmark arrays of an SMPL-X file."""
    face, bary = _embed(_fixed_points(), vertices, faces)
    # Rows: 0 to 39 degrees, then -1 to -39.
    yaws = np.radians(np.concatenate([np.arange(40), -np.arange(1, 40)]))
    moving = np.concatenate([_contour_points(yaw) for yaw in yaws])
    move_face, move_bary = _embed(moving, vertices, faces)
    return {
        "lmk_faces_idx": face,
        "lmk_bary_coords": bary,
        "dynamic_lmk_faces_idx": move_face.reshape(79, 17),
        "dynamic_lmk_bary_coords": move_bary.reshape(79, 17, 3),
    }
