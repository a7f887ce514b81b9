"""Closest points, winding numbers and nearest vertices, with libigl and SciPy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from .surface import check_mesh, check_points


class ClosestPoints(NamedTuple):
    """Closest points on a mesh, with their distances (in the mesh's unit) and face indices."""

    distance: Float[np.ndarray, "N"]
    face: Int[np.ndarray, "N"]
    point: Float[np.ndarray, "N 3"]


class ClosestPointTree:
    """Bounding-volume tree of a mesh for many closest-point queries."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Build the tree over vertices (V, 3) and faces (F, 3); `check_mesh` lists the errors."""
        import igl

        self._vertices, self._faces = check_mesh(vertices, faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def query(self, points: ArrayLike) -> ClosestPoints:
        """Closest point on the triangles for each of `points` (N, 3), in the mesh's unit."""
        queries = check_points(points)
        if len(queries) == 0:
            return ClosestPoints(np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3)))
        squared, face, point = self._tree.squared_distance(self._vertices, self._faces, queries)
        distance = np.sqrt(np.maximum(squared.reshape(-1), 0.0))
        return ClosestPoints(distance, face.reshape(-1), point.reshape(-1, 3))


class WindingNumberTree:
    """Bounding-volume tree of a mesh for many generalised-winding-number queries.

    The winding number is 1 inside a closed mesh whose faces point outwards and 0 outside. It
    changes smoothly near holes, and nested pieces add up: points with `> 0.5` are inside.

    Source: Barill et al. 2018, "Fast winding numbers for soups and clouds".
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Build the tree over vertices (V, 3) and faces (F, 3); `check_mesh` lists the errors."""
        import igl

        self._vertices, self._faces = check_mesh(vertices, faces)
        self._tree = None
        if hasattr(igl, "FastWindingNumberBVH"):
            self._tree = igl.FastWindingNumberBVH()
            self._tree.init(self._vertices, self._faces)

    def query(self, points: ArrayLike) -> Float[np.ndarray, "N"]:
        """Winding number at each of `points` (N, 3)."""
        queries = check_points(points)
        if len(queries) == 0:
            return np.zeros(0)
        if self._tree is not None:
            return self._tree.winding_number(queries).reshape(-1)
        import igl

        return igl.fast_winding_number(self._vertices, self._faces, queries).reshape(-1)


def winding_number(
    vertices: ArrayLike, faces: ArrayLike, points: ArrayLike
) -> Float[np.ndarray, "N"]:
    """Winding number of a mesh (V, 3), (F, 3) at points (N, 3); see `WindingNumberTree`."""
    return WindingNumberTree(vertices, faces).query(points)


def closest_points(vertices: ArrayLike, faces: ArrayLike, points: ArrayLike) -> ClosestPoints:
    """Closest points on the triangles of a mesh (V, 3), (F, 3) for points (N, 3)."""
    return ClosestPointTree(vertices, faces).query(points)


class VertexTree:
    """k-d tree of vertices for many nearest-vertex queries."""

    def __init__(self, vertices: ArrayLike) -> None:
        """Build the tree over vertices (V, 3).

        **Raises:** `ValueError` if there are no vertices, or they are misshapen or not finite.
        """
        from scipy.spatial import cKDTree

        targets = check_points(vertices, "vertices")
        if len(targets) == 0:
            raise ValueError("vertices must hold at least one vertex, found shape (0, 3).")
        # Such trees are faster to build and as fast to query for points of a surface.
        self._tree = cKDTree(targets, balanced_tree=False, compact_nodes=False)

    def query(self, points: ArrayLike) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
        """Distance to, and index of, the nearest vertex for each of `points` (N, 3)."""
        distance, index = self._tree.query(check_points(points), workers=-1)
        return distance, index.astype(np.int64)


def nearest_vertices(
    vertices: ArrayLike, points: ArrayLike
) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """Distance to, and index of, the nearest of `vertices` (V, 3) for each of `points` (N, 3)."""
    return VertexTree(vertices).query(points)
