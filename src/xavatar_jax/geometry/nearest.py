"""Nearest vertices."""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from ._check import check_points


def nearest_vertices(
    vertices: ArrayLike, points: ArrayLike
) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """Distance to, and index of, the nearest of `vertices` (V, 3) for each of `points` (N, 3).

    Raises:
        ValueError: if there are no vertices, or an array is misshapen or not finite.
    """
    from scipy.spatial import cKDTree

    targets, queries = check_points(vertices, "vertices"), check_points(points)
    if len(targets) == 0:
        raise ValueError("vertices must hold at least one vertex, found shape (0, 3).")
    # Unbalanced, uncompacted trees build faster and answer as fast on surfaces.
    tree = cKDTree(targets, balanced_tree=False, compact_nodes=False)
    distance, index = tree.query(queries, workers=-1)
    return distance, index.astype(np.int64)
