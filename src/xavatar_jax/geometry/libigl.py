"""The one place that knows libigl's names, which change between its releases."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from ._check import check_mesh, check_points


class ClosestPoints(NamedTuple):
    """Closest points on a mesh: distances (metres), face indices and the points themselves."""

    distance: Float[np.ndarray, "N"]
    face: Int[np.ndarray, "N"]
    point: Float[np.ndarray, "N 3"]


class ClosestPointTree:
    """A bounding-volume tree over one mesh, for many closest-point queries."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Build the tree over vertices (V, 3) and faces (F, 3).

        Raises:
            ValueError: if the mesh is empty, misshapen or not finite.
        """
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
    """A bounding-volume tree over one mesh, for many generalised-winding-number queries.

    The winding number is 1 inside a closed mesh whose faces point outwards and 0 outside; it
    degrades gracefully at holes, and nested pieces add up, so "inside" is `> 0.5`.

    Source: Barill et al. 2018, "Fast winding numbers for soups and clouds".
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Build the tree over vertices (V, 3) and faces (F, 3).

        Raises:
            ValueError: if the mesh is empty, misshapen or not finite.
        """
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
    """Generalised winding number of a mesh (V, 3), (F, 3) at points (N, 3); inside is `> 0.5`.

    Raises:
        ValueError: if the mesh is empty, or an array is misshapen or not finite.

    Source: Barill et al. 2018, "Fast winding numbers for soups and clouds".
    """
    return WindingNumberTree(vertices, faces).query(points)


def closest_points(vertices: ArrayLike, faces: ArrayLike, points: ArrayLike) -> ClosestPoints:
    """Closest points on the triangles of a mesh (V, 3), (F, 3) for points (N, 3).

    Returns distances (N,) in the mesh's unit, face indices (N,) and closest points (N, 3).

    Raises:
        ValueError: if the mesh is empty, or an array is misshapen or not finite.
    """
    return ClosestPointTree(vertices, faces).query(points)


def doubled_areas(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F"]:
    """Twice the area of each triangle of a checked mesh."""
    import igl

    return np.asarray(igl.doublearea(vertices, faces))


def area_weighted_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Unit normals at the vertices of a checked mesh; zero where no triangle has an area."""
    import igl

    weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA
    return np.nan_to_num(igl.per_vertex_normals(vertices, faces, weighting))
