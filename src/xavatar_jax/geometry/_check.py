"""Checks of mesh arrays, so that a bad shape is an error here and not a crash in compiled code."""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike


def check_points(points: ArrayLike, name: str = "points") -> Float[np.ndarray, "N 3"]:
    """Return `points` as contiguous float64 (N, 3).

    Raises:
        ValueError: if the shape is not (N, 3) or a coordinate is not finite.
    """
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} must have shape (N, 3), found {array.shape}.")
    if not np.isfinite(array).all():
        bad = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise ValueError(f"{name} must be finite, but row {bad} is {array[bad].tolist()}.")
    return array


def check_mesh(
    vertices: ArrayLike, faces: ArrayLike
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Return contiguous float64 vertices (V, 3) and int64 faces (F, 3).

    Raises:
        ValueError: if a shape is wrong, the mesh is empty, a coordinate is not finite, or a
            face names a vertex that does not exist.
    """
    checked = check_points(vertices, "vertices")
    index = np.asarray(faces)
    if index.ndim != 2 or index.shape[1] != 3 or index.dtype.kind not in "iu":
        raise ValueError(
            f"faces must be integers of shape (F, 3), found {index.dtype} {index.shape}. "
            "Triangulate the mesh first."
        )
    index = np.ascontiguousarray(index, dtype=np.int64)
    if len(checked) == 0 or len(index) == 0:
        raise ValueError(
            f"the mesh is empty: {len(checked)} vertices and {len(index)} faces; "
            "at least one face is needed."
        )
    low, high = int(index.min()), int(index.max())
    if low < 0 or high >= len(checked):
        raise ValueError(
            f"faces name vertices {low} to {high}, but the mesh has {len(checked)} vertices "
            f"(0 to {len(checked) - 1})."
        )
    return checked, index
