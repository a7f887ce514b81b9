"""Areas, normals, sums over faces and random samples of a triangle surface."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, DTypeLike

from ._check import check_mesh
from .libigl import area_weighted_normals, doubled_areas

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


def _doubled_area_vectors(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Edge cross products: twice the area, along the outward normal."""
    corner = vertices[faces[:, 0]]
    return np.cross(vertices[faces[:, 1]] - corner, vertices[faces[:, 2]] - corner)


def _normalised(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Unit vectors; a zero vector (a degenerate triangle) stays zero rather than NaN."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def face_areas(vertices: ArrayLike, faces: ArrayLike) -> Float[np.ndarray, "F"]:
    """Area of each triangle, for vertices (V, 3) and faces (F, 3).

    Raises:
        ValueError: if the mesh is empty, misshapen or not finite.
    """
    return doubled_areas(*check_mesh(vertices, faces)) / 2


def face_normals(vertices: ArrayLike, faces: ArrayLike) -> Float[np.ndarray, "F 3"]:
    """Unit normal of each triangle by the right-hand rule; zero for a degenerate triangle.

    Raises:
        ValueError: if the mesh is empty, misshapen or not finite.
    """
    return _normalised(_doubled_area_vectors(*check_mesh(vertices, faces)))


def vertex_normals(vertices: ArrayLike, faces: ArrayLike) -> Float[np.ndarray, "V 3"]:
    """Unit normal of each vertex: area-weighted mean of its faces; zero if it has none.

    Raises:
        ValueError: if the mesh is empty, misshapen or not finite.
    """
    return area_weighted_normals(*check_mesh(vertices, faces))


def corner_matrix(faces: Int[np.ndarray, "F 3"], count: int, dtype: DTypeLike) -> "csc_matrix":
    """Of `count` vertices and F faces, 1 where a vertex is a corner of a face: (V, F), sparse.

    `matrix @ x` sums over the faces at each vertex, `matrix.T @ x` over the corners of each face.
    """
    from scipy.sparse import csc_matrix

    # Column by column, where each face's three ones are.
    starts = np.arange(0, faces.size + 1, 3)
    ones = np.ones(faces.size, dtype=dtype)
    return csc_matrix((ones, faces.reshape(-1), starts), shape=(count, len(faces)))


def enclosed_volume(vertices: ArrayLike, faces: ArrayLike) -> float:
    """Signed volume of a closed mesh, positive if its faces point outwards.

    Raises:
        ValueError: if the mesh is empty, misshapen or not finite.
    """
    checked, index = check_mesh(vertices, faces)
    # About the mean, so that a mesh far from the origin loses no digits.
    corners = (checked - checked.mean(axis=0))[index]
    triple = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return float(triple.sum() / 6.0)


def sample_surface(
    vertices: ArrayLike, faces: ArrayLike, n: int, rng: np.random.Generator | int
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "N"]]:
    """Draw `n` points uniformly by area from a mesh (V, 3), (F, 3).

    Returns points (n, 3) and the face (n,) each came from. `rng` is a generator or a seed.

    Raises:
        ValueError: if the mesh is empty, misshapen, not finite, or has no area, or `n` < 0.
    """
    if n < 0:
        raise ValueError(f"the number of samples must be 0 or more, found {n}.")
    checked, index = check_mesh(vertices, faces)
    area = np.linalg.norm(_doubled_area_vectors(checked, index), axis=1)
    total = np.cumsum(area)
    if not total[-1] > 0:
        raise ValueError(f"cannot sample a surface without area: all {len(index)} faces have 0.")
    generator = np.random.default_rng(rng)
    face = np.searchsorted(total, generator.random(n) * total[-1], side="right")
    face = np.minimum(face, len(index) - 1)
    # The square root makes the first coordinate uniform over the triangle's area.
    root, fraction = np.sqrt(generator.random(n)), generator.random(n)
    weights = np.stack([1.0 - root, root * (1.0 - fraction), root * fraction], axis=1)
    return np.einsum("nk,nki->ni", weights, checked[index[face]]), face
