"""A closed surface from a field: dual contouring's topology on an adaptive octree.

There is one vertex for each leaf that the surface crosses, and one polygon for each smallest
crossed leaf edge, joining the leaves around it (Ju et al. 2002, "Dual contouring of Hermite
data"). Vertices are placed at the mean of their crossings and later moved onto the surface. Leaves
at non-manifold edges are split and the surface is extracted again.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from .field import Field, on_grid
from .topology import bad_edges, split_fans

_UNIT = 0.00075  # smallest leaf, metres
_ROOT = 64  # largest leaf, units
_SHIFT = 1 << 13
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _code(cells: np.ndarray) -> np.ndarray:
    c = cells.astype(np.int64) + _SHIFT
    return (c[..., 0] << 42) | (c[..., 1] << 21) | c[..., 2]


def _children(origin: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    half = size // 2
    origin = (origin[:, None] + _CORNERS[None] * half[:, None, None]).reshape(-1, 3)
    return origin, np.repeat(half, 8)


def _leaves(
    field: Field, target: Callable[[np.ndarray], np.ndarray], box: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Leaves near the surface, x >= 0 half only, in units of the smallest leaf."""
    span = _ROOT * _UNIT
    low = np.floor(box[0] / span).astype(int)
    high = np.ceil(box[1] / span).astype(int)
    low[0] = 0
    axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    origin = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) * _ROOT
    size = np.full(len(origin), _ROOT)
    done_origin, done_size = [], []
    while len(origin):
        centre = (origin + 0.5 * size[:, None]) * _UNIT
        # Near carved details the field overestimates distances, hence the large factor.
        near = np.abs(field(centre)) < 1.25 * size * _UNIT + 0.001
        origin, size, centre = origin[near], size[near], centre[near]
        final = (size * _UNIT <= target(centre)) | (size == 1)
        done_origin.append(origin[final])
        done_size.append(size[final])
        origin, size = _children(origin[~final], size[~final])
    return np.concatenate(done_origin), np.concatenate(done_size)


class _Lookup:
    """Finds the leaf that contains a point given in half units."""

    def __init__(self, origin: np.ndarray, size: np.ndarray):
        self.levels = []
        for s in np.unique(size):
            index = np.flatnonzero(size == s)
            codes = _code(origin[index])
            order = np.argsort(codes)
            self.levels.append((int(s), codes[order], index[order]))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        found = np.full(len(points), -1)
        for s, codes, index in self.levels:
            cell = np.floor_divide(points, 2 * s) * s
            code = _code(cell)
            at = np.minimum(np.searchsorted(codes, code), len(codes) - 1)
            hit = codes[at] == code
            found[hit] = index[at[hit]]
        return found


def _contour(
    field: Field, origin: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, triangles and the leaf of each vertex."""
    # Mirror the half that was built; corners on the mirror plane coincide.
    mirrored = origin.copy()
    mirrored[:, 0] = -origin[:, 0] - size
    origin = np.concatenate([origin, mirrored])
    size = np.concatenate([size, size])

    corner = origin[:, None] + _CORNERS[None] * size[:, None, None]
    half = corner[: len(origin) // 2].reshape(-1, 3)
    unique, back = np.unique(_code(half), return_inverse=True)
    sample = np.zeros((len(unique), 3))
    sample[back] = half
    values = field(sample * _UNIT)[back].reshape(-1, 8)
    values = np.concatenate([values, values[:, [4, 5, 6, 7, 0, 1, 2, 3]]])
    inside = values < 0.0

    starts, axes, lengths, signs, cross = [], [], [], [], []
    for axis in range(3):
        step = 4 >> axis
        for c in range(8):
            if c & step:
                continue
            leaf = np.flatnonzero(inside[:, c] != inside[:, c + step])
            starts.append(corner[leaf, c])
            axes.append(np.full(len(leaf), axis))
            lengths.append(size[leaf])
            signs.append(inside[leaf, c])
            a, b = values[leaf, c], values[leaf, c + step]
            cross.append(a / (a - b))
    start, axis = np.concatenate(starts), np.concatenate(axes)
    length, sign, cross = np.concatenate(lengths), np.concatenate(signs), np.concatenate(cross)
    key = (_code(start) * 3 + axis) * 128 + length
    _, first = np.unique(key, return_index=True)
    start, axis, length = start[first], axis[first], length[first]
    sign, cross = sign[first], cross[first]

    lookup = _Lookup(origin, size)
    middle = 2 * start
    middle[np.arange(len(axis)), axis] += length
    around = np.zeros((len(axis), 4), dtype=int)
    rows = np.arange(len(axis))
    for k, (db, dc) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        q = middle.copy()
        q[rows, (axis + 1) % 3] += db
        q[rows, (axis + 2) % 3] += dc
        around[:, k] = lookup(q)
    # Only smallest edges: no leaf around is smaller than the edge.
    whole = (around >= 0).all(1) & (size[around].min(1) >= length)
    start, axis, length, sign, cross, around = (
        a[whole] for a in (start, axis, length, sign, cross, around)
    )

    point = start * _UNIT
    point[np.arange(len(axis)), axis] += cross * length * _UNIT
    total = np.zeros((len(origin), 3))
    count = np.zeros(len(origin))
    for k in range(4):
        np.add.at(total, around[:, k], point)
        np.add.at(count, around[:, k], 1.0)
    leaf = np.flatnonzero(count)
    number = np.full(len(origin), -1)
    number[leaf] = np.arange(len(leaf))
    vertices = on_grid(total[leaf] / count[leaf, None])

    quads = number[around]
    quads[~sign] = quads[~sign][:, ::-1]
    d02 = ((vertices[quads[:, 0]] - vertices[quads[:, 2]]) ** 2).sum(1)
    d13 = ((vertices[quads[:, 1]] - vertices[quads[:, 3]]) ** 2).sum(1)
    turn = d13 < d02
    quads[turn] = np.roll(quads[turn], -1, axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    distinct = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    return vertices, faces[distinct], leaf % (len(origin) // 2)


def extract(
    field: Field, target: Callable[[np.ndarray], np.ndarray], box: np.ndarray
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """The closed, oriented manifold {field = 0} with edges of about the length `target`.

    **Raises:** `RuntimeError` if the leaves cannot be refined to a manifold.
    """
    origin, size = _leaves(field, target, box)
    for _ in range(8):
        vertices, faces, leaf = _contour(field, origin, size)
        bad = bad_edges(faces)
        if not len(bad):
            return split_fans(vertices, faces)
        split = np.zeros(len(origin), dtype=bool)
        split[leaf[bad.ravel()]] = True
        split &= size > 1
        if not split.any():
            break
        extra = _children(origin[split], size[split])
        origin = np.concatenate([origin[~split], extra[0]])
        size = np.concatenate([size[~split], extra[1]])
    raise RuntimeError(
        f"the body's surface is not a manifold at {len(bad)} edges, "
        f"first near {vertices[bad[0, 0]].round(4)}: adjust the field there"
    )
