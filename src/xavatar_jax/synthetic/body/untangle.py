"""Find intersecting triangles and separate them by smoothing.

A level set does not intersect itself, but its triangulation can at a crease such as the corner of
an eye, depending on rounding. So every mesh is checked.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from .topology import Edges


def _near_pairs(corner: np.ndarray) -> np.ndarray:
    """Pairs of triangles whose bounding boxes overlap."""
    from scipy.spatial import cKDTree

    low, high = corner.min(1), corner.max(1)
    centre, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)
    order = np.argsort(radius)
    # Groups of similar size keep the search radius small for small triangles.
    bounds = np.searchsorted(radius[order], radius.min() * 1.6 ** np.arange(1, 40))
    groups = [g for g in np.split(order, np.unique(bounds)) if len(g)]
    trees = [cKDTree(centre[g]) for g in groups]
    pairs = []
    for i, small in enumerate(groups):
        for k in range(i, len(groups)):
            reach = radius[small[-1]] + radius[groups[k][-1]]
            near = trees[k].query_ball_point(centre[small], reach)
            count = np.fromiter(map(len, near), dtype=np.int64, count=len(near))
            if not count.sum():
                continue
            a = np.repeat(small, count)
            b = groups[k][np.concatenate([np.asarray(n, dtype=np.int64) for n in near])]
            meet = ((low[a] <= high[b]) & (low[b] <= high[a])).all(1)
            meet &= (a < b) if k == i else (a != b)
            pairs.append(np.stack([a[meet], b[meet]], 1))
    return np.concatenate(pairs)


def _pierces(tri: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether segments intersect triangles, by the signs of tetrahedron volumes."""

    def volume(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
        return (np.cross(b - a, c - a) * (d - a)).sum(1)

    a, b, c = tri[:, 0], tri[:, 1], tri[:, 2]
    across = volume(a, b, c, start) * volume(a, b, c, end) < 0.0
    s = [volume(start, end, p, q) for p, q in ((a, b), (b, c), (c, a))]
    around = (s[0] * s[1] > 0.0) & (s[1] * s[2] > 0.0)
    return across & around


def crossings(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "P 2"]:
    """Pairs of intersecting triangles without a common vertex."""
    corner = vertices[faces]
    pairs = _near_pairs(corner)
    one, two = faces[pairs[:, 0]], faces[pairs[:, 1]]
    pairs = pairs[~(one[:, :, None] == two[:, None, :]).any((1, 2))]
    hit = np.zeros(len(pairs), dtype=bool)
    for a, b in ((0, 1), (1, 0)):
        tri, other = corner[pairs[:, a]], corner[pairs[:, b]]
        for k in range(3):
            hit |= _pierces(tri, other[:, k], other[:, (k + 1) % 3])
    return pairs[hit]


def untangle(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rounds: int = 30
) -> Float[np.ndarray, "V 3"]:
    """Smooth the neighbourhood of intersecting triangles until none intersect.

    **Raises:** `RuntimeError` if some still do after all rounds.
    """
    pairs = Edges(faces).pairs
    count = len(vertices)
    for _ in range(rounds):
        bad = crossings(vertices, faces)
        if not len(bad):
            return vertices
        touched = np.zeros(count, dtype=bool)
        touched[faces[bad.ravel()].ravel()] = True
        total, mass = np.zeros_like(vertices), np.zeros(count)
        for i, j in ((0, 1), (1, 0)):
            mass += np.bincount(pairs[:, i], minlength=count)
            for d in range(3):
                total[:, d] += np.bincount(pairs[:, i], vertices[pairs[:, j], d], minlength=count)
        mean = total / mass[:, None]
        vertices = np.where(touched[:, None], 0.6 * vertices + 0.4 * mean, vertices)
    raise RuntimeError(f"{len(bad)} pairs of triangles of the body still cut each other")
