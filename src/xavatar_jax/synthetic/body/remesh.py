"""Graded isotropic remeshing on a level set: split, collapse, flip, relax, project.

The rounds of Botsch and Kobbelt (2004), with each operation applied at once to an independent set
of edges, which vectorises in NumPy. All operations preserve closed manifolds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .field import Field, gradient, on_grid
from .topology import Edges, vertex_normals

Target = Callable[[np.ndarray], np.ndarray]


def project(field: Field, v: np.ndarray, limit: np.ndarray, rounds: int) -> np.ndarray:
    """Newton steps to the zero level, each no longer than `limit`."""
    for _ in range(rounds):
        value, slope = gradient(field, v, 0.04 * limit + 1e-5)
        size = np.maximum((slope * slope).sum(1), 0.09)
        step = -value / size
        step = np.clip(step * np.sqrt(size), -limit, limit) / np.sqrt(size)
        v = v + step[:, None] * slope
    return on_grid(v)


def _independent(edges: Edges, wanted: np.ndarray, score: np.ndarray) -> np.ndarray:
    """The selected edges that have the highest score in both of their faces."""
    rank = np.full(len(edges.pairs), -1.0)
    order = np.argsort(score[wanted], kind="stable")
    rank[np.flatnonzero(wanted)[order]] = np.arange(len(order))
    best = rank[edges.of_face].max(1)
    return np.flatnonzero(wanted & (rank[:, None] == best[edges.faces]).all(1))


def _lengths(v: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.linalg.norm(v[pairs[:, 0]] - v[pairs[:, 1]], axis=1)


def _area_vectors(v: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (v[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def split_long(
    v: np.ndarray, faces: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Halve edges longer than `limit` (per vertex; the smaller of the two ends counts)."""
    edges = Edges(faces)
    length = _lengths(v, edges.pairs)
    ratio = length / limit[edges.pairs].min(1)
    chosen = _independent(edges, ratio > 1.0, ratio)
    if not len(chosen):
        return v, faces, 0
    middle = 0.5 * (v[edges.pairs[chosen, 0]] + v[edges.pairs[chosen, 1]])
    new = len(v) + np.arange(len(chosen))
    faces = faces.copy()
    extra = []
    for side in (0, 1):
        f, k = edges.faces[chosen, side], edges.half[chosen, side] % 3
        second = faces[f].copy()
        rows = np.arange(len(f))
        # One half keeps corner k, the other corner k + 1.
        second[rows, k] = new
        faces[f, (k + 1) % 3] = new
        extra.append(second)
    return np.concatenate([v, middle]), np.concatenate([faces, *extra]), len(chosen)


def collapse_short(
    v: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, int]:
    """Collapse edges shorter than `low`, unless that creates an edge longer than `high`."""
    from scipy.sparse import coo_matrix

    edges = Edges(faces)
    a, b = edges.pairs.T
    length = _lengths(v, edges.pairs)
    n = len(v)
    wanted = length < 0.5 * (low[a] + low[b])
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    graph = graph + graph.T
    valence = np.diff(graph.indptr)
    # Link condition: the ends share only the two opposite vertices.
    index = np.flatnonzero(wanted)
    shared = np.asarray(graph[a[index]].multiply(graph[b[index]]).sum(1)).ravel()
    fine = (shared == 2) & (valence[edges.opposite[index]].min(1) > 4)
    fine &= valence[a[index]] + valence[b[index]] - 4 <= 9
    index = index[fine]
    if not len(index):
        return v, faces, 0
    # No two collapses may touch the same ring: keep local minima of a pseudorandom priority.
    rank = length[index] / (low[a[index]] + low[b[index]]) + 0.2 * rng.random(len(index))
    claim = np.full(n, np.inf)
    np.minimum.at(claim, a[index], rank)
    np.minimum.at(claim, b[index], rank)
    for _ in range(2):
        spread = claim.copy()
        np.minimum.at(spread, a, claim[b])
        np.minimum.at(spread, b, claim[a])
        claim = spread
    keep = (claim[a[index]] == rank) & (claim[b[index]] == rank)
    index = index[keep]
    middle = 0.5 * (v[a[index]] + v[b[index]])
    moved = v.copy()
    moved[a[index]] = middle
    moved[b[index]] = middle
    # Undo those that would make edges too long or flip a face.
    owner = np.full(n, -1)
    owner[a[index]] = np.arange(len(index))
    owner[b[index]] = np.arange(len(index))
    bad = np.zeros(len(index), dtype=bool)
    stretched = _lengths(moved, edges.pairs) > np.maximum(np.minimum(high[a], high[b]), length)
    for end in (a, b):
        bad[owner[end[stretched & (owner[end] >= 0)]]] = True
    before, after = _area_vectors(v, faces), _area_vectors(moved, faces)
    gone = np.zeros(len(faces), dtype=bool)
    gone[edges.faces[index].ravel()] = True
    cosine = (before * after).sum(1)
    turned = cosine < 0.5 * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    turned &= ~gone
    at = owner[faces[turned]]
    bad[at[at >= 0]] = True

    index = index[~bad]
    v = v.copy()
    v[a[index]] = 0.5 * (v[a[index]] + v[b[index]])
    target = np.arange(n)
    target[b[index]] = a[index]
    keep_face = np.ones(len(faces), dtype=bool)
    keep_face[edges.faces[index].ravel()] = False
    faces = target[faces[keep_face]]
    alive = np.ones(n, dtype=bool)
    alive[b[index]] = False
    number = np.cumsum(alive) - 1
    return v[alive], number[faces], len(index)


def flip_edges(v: np.ndarray, faces: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, int]:
    """Flip edges whose opposite angles sum to more than 180 degrees (towards Delaunay).

    No edge longer than `limit` (per vertex) is created.
    """
    edges = Edges(faces)
    a = faces[edges.faces[:, 0], edges.half[:, 0] % 3]
    b = faces[edges.faces[:, 0], (edges.half[:, 0] % 3 + 1) % 3]
    c, d = edges.opposite.T

    def angle(at: np.ndarray) -> np.ndarray:
        s, t = v[a] - v[at], v[b] - v[at]
        return np.arctan2(np.linalg.norm(np.cross(s, t), axis=1), (s * t).sum(1))

    excess = angle(c) + angle(d) - np.pi
    valence = np.bincount(edges.pairs.ravel(), minlength=len(v))
    # The new faces (a, d, c) and (d, b, c) must have the orientation of the old ones.
    old = np.cross(v[b] - v[a], v[c] - v[a]) + np.cross(v[d] - v[a], v[b] - v[a])
    old /= np.maximum(np.linalg.norm(old, axis=1, keepdims=True), 1e-20)
    ok = excess > 0.02
    for x, y, z in ((a, d, c), (d, b, c)):
        n = np.cross(v[y] - v[x], v[z] - v[x])
        ok &= (n * old).sum(1) > 0.75 * np.linalg.norm(n, axis=1)
    ok &= (valence[a] > 4) & (valence[b] > 4)
    ok &= np.linalg.norm(v[c] - v[d], axis=1) <= np.minimum(limit[c], limit[d])
    size = len(v)
    old_code = edges.pairs[:, 0] * size + edges.pairs[:, 1]
    new_code = np.minimum(c, d) * size + np.maximum(c, d)
    ok &= ~np.isin(new_code, old_code)
    chosen = _independent(edges, ok, excess)
    _, first = np.unique(new_code[chosen], return_index=True)
    chosen = chosen[first]
    faces = faces.copy()
    faces[edges.faces[chosen, 0]] = np.stack([a[chosen], d[chosen], c[chosen]], 1)
    faces[edges.faces[chosen, 1]] = np.stack([d[chosen], b[chosen], c[chosen]], 1)
    return faces, len(chosen)


def relax(
    field: Field, v: np.ndarray, faces: np.ndarray, target: Target, strength: float = 0.6
) -> np.ndarray:
    """Move vertices tangentially towards the mean of their neighbours, then project."""
    wanted = target(v)
    pairs = Edges(faces).pairs
    # Weights of length over target length make edges converge to their target ratio.
    weight = _lengths(v, pairs) / wanted[pairs].mean(1) ** 2
    total = np.zeros_like(v)
    mass = np.zeros(len(v))
    for i, j in ((0, 1), (1, 0)):
        at, of = pairs[:, i], pairs[:, j]
        mass += np.bincount(at, weight, minlength=len(v))
        for d in range(3):
            total[:, d] += np.bincount(at, weight * v[of, d], minlength=len(v))
    move = total / mass[:, None] - v
    normal = vertex_normals(v, faces)
    move -= normal * (move * normal).sum(1, keepdims=True)
    length = np.linalg.norm(move, axis=1)
    move *= (np.minimum(length, 0.4 * wanted) / np.maximum(length, 1e-12))[:, None]
    return project(field, v + strength * move, 0.3 * wanted, rounds=1)


def remesh(
    field: Field,
    v: np.ndarray,
    faces: np.ndarray,
    target: Target,
    ceiling: Target,
    rounds: int = 6,
) -> tuple[np.ndarray, np.ndarray]:
    """Remesh the level set to edges of `target` length and well-shaped triangles.

    Edges with both ends where `ceiling` applies are at most that long.
    """
    rng = np.random.default_rng(0)
    v = project(field, v, 0.5 * target(v), rounds=2)
    for round_ in range(rounds):
        for _ in range(40 if round_ == 0 else 4):
            wanted = target(v)
            high = np.minimum(1.35 * wanted, 1.05 * ceiling(v))
            v, faces, count = collapse_short(v, faces, 0.87 * wanted, high, rng)
            if count < 20:
                break
        for _ in range(2):
            v, faces, count = split_long(v, faces, 1.33 * target(v))
            if not count:
                break
        for _ in range(3):
            faces, count = flip_edges(v, faces, ceiling(v))
            if not count:
                break
        for _ in range(2 if round_ >= rounds // 2 else 1):
            v = relax(field, v, faces, target)
    # Halve the edges that are still too long, with little movement afterwards.
    for _ in range(6):
        v, faces, count = split_long(v, faces, np.minimum(1.4 * target(v), ceiling(v)))
        if not count:
            break
        faces, _ = flip_edges(v, faces, ceiling(v))
        v = project(field, v, 0.1 * target(v), rounds=1)
    return v, faces
