"""Checks of mesh arrays; areas, normals, volume and random samples of triangle meshes.

Functions of a mesh take vertices (V, 3) and faces (F, 3) and raise the errors of `check_mesh`.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, DTypeLike

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


def check_points(points: ArrayLike, name: str = "points") -> Float[np.ndarray, "N 3"]:
    """Return `points` as contiguous float64 (N, 3).

    **Raises:** `ValueError` if the shape is not (N, 3) or a coordinate is not finite.
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

    **Raises:** `ValueError` if a shape is wrong, the mesh is empty, a coordinate is not finite, or
    a face names a vertex that does not exist.
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


def _doubled_area_vectors(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Cross products of edges: outward normals with twice the triangles' areas as length."""
    corner = vertices[faces[:, 0]]
    return np.cross(vertices[faces[:, 1]] - corner, vertices[faces[:, 2]] - corner)


def _normalised(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Unit vectors; a zero vector (of a degenerate triangle) stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def face_areas(vertices: ArrayLike, faces: ArrayLike) -> Float[np.ndarray, "F"]:
    """Area of each triangle."""
    import igl

    return np.asarray(igl.doublearea(*check_mesh(vertices, faces))) / 2


def face_normals(vertices: ArrayLike, faces: ArrayLike) -> Float[np.ndarray, "F 3"]:
    """Unit normal of each triangle by the right-hand rule; zero for a degenerate triangle."""
    return _normalised(_doubled_area_vectors(*check_mesh(vertices, faces)))


def vertex_normals(vertices: ArrayLike, faces: ArrayLike) -> Float[np.ndarray, "V 3"]:
    """Unit normal of each vertex: area-weighted mean of its faces; zero if it has none."""
    import igl

    weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA
    return np.nan_to_num(igl.per_vertex_normals(*check_mesh(vertices, faces), weighting))


def corner_matrix(faces: Int[np.ndarray, "F 3"], count: int, dtype: DTypeLike) -> "csc_matrix":
    """Sparse incidence matrix (V, F) of `count` vertices: 1 where a vertex is a corner of a face.

    `matrix @ x` sums over the faces at each vertex, `matrix.T @ x` over the corners of each face.
    """
    from scipy.sparse import csc_matrix

    starts = np.arange(0, faces.size + 1, 3)
    ones = np.ones(faces.size, dtype=dtype)
    return csc_matrix((ones, faces.reshape(-1), starts), shape=(count, len(faces)))


def enclosed_volume(vertices: ArrayLike, faces: ArrayLike) -> float:
    """Signed volume of a closed mesh, positive if its faces point outwards."""
    checked, index = check_mesh(vertices, faces)
    # Relative to the mean, so that a mesh far from the origin loses no digits.
    corners = (checked - checked.mean(axis=0))[index]
    triple = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return float(triple.sum() / 6.0)


def sample_surface(
    vertices: ArrayLike, faces: ArrayLike, n: int, rng: np.random.Generator | int
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "N"]]:
    """Draw `n` points uniformly by area. Returns points (n, 3) and their faces (n,).

    **Raises:** `ValueError` for `n` < 0, a mesh without area, or as `check_mesh`.
    """
    if n < 0:
        raise ValueError(f"the number of samples must be 0 or more, found {n}.")
    checked, index = check_mesh(vertices, faces)
    area = np.linalg.norm(_doubled_area_vectors(checked, index), axis=1)
    total = np.cumsum(area)
    if not total[-1] > 0:
        raise ValueError(f"cannot sample a surface without area ({len(index)} faces of area 0).")
    generator = np.random.default_rng(rng)
    face = np.searchsorted(total, generator.random(n) * total[-1], side="right")
    face = np.minimum(face, len(index) - 1)
    # The square root makes the points uniform by area.
    root, fraction = np.sqrt(generator.random(n)), generator.random(n)
    weights = np.stack([1.0 - root, root * (1.0 - fraction), root * fraction], axis=1)
    return np.einsum("nk,nki->ni", weights, checked[index[face]]), face
