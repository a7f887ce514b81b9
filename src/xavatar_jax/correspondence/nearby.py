"""Start rows of points without a label: by the parts of the posed body that are near."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..body import EYES_MOUTH, FACE, PARTS
from .starts import PAIR_ROWS

# A point this close to two parts, in metres, may belong to either, or to both where they touch.
NEAR = 0.03


class RowFinder:
    """Finds, for any points of one frame, the rows of a start table made with `pairs`.

    A point's row is that of the part of the nearest posed vertex, or of a pair of parts if a
    vertex of another part lies within `near` metres too. So no seam runs where labels change.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        labels: Int[np.ndarray, " V"],
        *,
        near: float = NEAR,
    ):
        from scipy.spatial import cKDTree

        self._near = near
        # Unbalanced, uncompacted trees build faster and answer as fast on surfaces.
        options: dict[str, Any] = {"balanced_tree": False, "compact_nodes": False}
        self._all = cKDTree(vertices, **options)
        # Eyes and mouth start as the face does: they are no second part beside it.
        self._labels = np.where(labels == EYES_MOUTH, FACE, labels)
        self._parts = [
            cKDTree(vertices[self._labels == part], **options) for part in range(len(PARTS))
        ]

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
        points = np.asarray(points, np.float64)
        finite = np.isfinite(points).all(axis=-1)
        first = np.zeros(len(points), np.int32)
        # A point that is not finite is reported by the search.
        first[finite] = self._labels[self._all.query(points[finite], workers=-1)[1]]
        second, best = first.copy(), np.full(len(points), np.inf)
        for part, tree in enumerate(self._parts):
            rows = np.flatnonzero(finite & (first != part))
            if not tree.n or not len(rows):
                continue
            away = tree.query(points[rows], distance_upper_bound=self._near, workers=-1)[0]
            closer = away < best[rows]
            second[rows[closer]], best[rows[closer]] = part, away[closer]
        return PAIR_ROWS[first, second].astype(np.int32)
