"""Inside tests for very many points."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..geometry import WindingNumberTree
from ..meshing import Mesh

_CELLS = 1_000_000
_FEW = 2000
_MOST_MARKED = 20_000_000


class Solid:
    """The points with a winding number above 0.5; nested pieces count as inside.

    The winding number of a closed mesh is constant in a connected region that the surface does not
    cross. Space is divided into cells: points in cells near the surface are tested one by one, and
    one point is tested for each connected region of other cells.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._tree = WindingNumberTree(mesh.vertices, mesh.faces)
        self._closed = is_closed(mesh.faces)
        corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)

    def contains(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Whether each point is inside."""
        regions = self._regions(points) if self._closed and len(points) > _FEW else None
        if regions is None:
            return self._tree.query(points) > 0.5
        # Region 0 is near the surface; the first point of any other region decides for all.
        found, first, which = np.unique(regions, return_index=True, return_inverse=True)
        near = np.flatnonzero(regions == 0)
        asked = np.concatenate([near, first[found != 0]])
        inside = self._tree.query(points[asked]) > 0.5
        by_region = np.zeros(len(found), bool)
        by_region[found != 0] = inside[len(near) :]
        answer = by_region[which]
        answer[near] = inside[: len(near)]
        return answer

    def _regions(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"] | None:
        """The region of each point, 0 near the surface; None if there would be too many cells."""
        from scipy.ndimage import label

        low, high = points.min(axis=0), points.max(axis=0)
        cell = float(np.cbrt(np.prod(np.maximum(high - low, 1e-9)) / _CELLS))
        shape = np.floor((high - low) / cell).astype(np.int64) + 1
        if np.prod(shape) > 4 * _CELLS:
            return None
        first = np.floor((self._low - low) / cell - 1e-6).astype(np.int64)
        last = np.floor((self._high - low) / cell + 1e-6).astype(np.int64)
        crossing = np.flatnonzero(((last >= 0) & (first < shape)).all(axis=1))
        first = np.maximum(first[crossing], 0)
        spans = np.minimum(last[crossing], shape - 1) - first + 1
        counts = spans.prod(axis=1)
        if counts.sum() > _MOST_MARKED:
            return None
        # All cells of each triangle's bounding box, numbered within the box.
        rows = np.repeat(np.arange(len(counts)), counts)
        number = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        spans, first = spans[rows], first[rows]
        rest, z = np.divmod(number, spans[:, 2])
        x, y = np.divmod(rest, spans[:, 1])
        free = np.ones(shape, bool)
        free[first[:, 0] + x, first[:, 1] + y, first[:, 2] + z] = False
        labelled: Any = label(free)
        regions = np.asarray(labelled[0])
        at = np.minimum(((points - low) / cell).astype(np.int64), shape - 1)
        return regions[at[:, 0], at[:, 1], at[:, 2]]


def is_closed(faces: Int[np.ndarray, "F 3"]) -> bool:
    """Whether every edge occurs equally often in both directions."""
    start = faces.reshape(-1).astype(np.int64)
    end = faces[:, [1, 2, 0]].reshape(-1).astype(np.int64)
    count = int(faces.max()) + 1
    return np.array_equal(np.sort(start * count + end), np.sort(end * count + start))
