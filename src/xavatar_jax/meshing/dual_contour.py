"""The surface between leaves of an octree: marching cubes on the octree's dual grid.

Every corner where leaves meet is the middle of a dual cube whose corners are the centres of the
eight leaves around it (one large leaf may be several of them). Dual cubes fill space without gaps
whatever the sizes of the leaves, so marching cubes on them is closed and manifold without special
treatment of cracks. A surface vertex lies between two face-adjacent leaves of opposite sign, which
identify it.

Source: Schaefer and Warren 2004, "Dual marching cubes: primal contouring of dual grids".
"""

from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .octree import Octree
from .sampler import in_blocks

_AROUND = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=np.int32) - 1
# Dual cubes processed at a time, which bounds the memory.
_BLOCK = 1 << 15
MAX_POLYGONS, MAX_SIDES = 4, 12


class Polygons(NamedTuple):
    """A closed polygon mesh without positions.

    Attributes:
        leaves: the two leaves, inside one first, that each vertex lies between (V, 2).
        corners: vertices of each polygon in order, outward, padded by -1 (P, 12).
        sides: number of corners of each polygon (P,).
    """

    leaves: Int[np.ndarray, "V 2"]
    corners: Int[np.ndarray, "P 12"]
    sides: Int[np.ndarray, "P"]


def dual_polygons(tree: Octree, pairs: Int[np.ndarray, "K 2"]) -> Polygons:
    """Polygons of the surface between the leaf `pairs` of opposite sign, finer leaf first."""
    inside = tree.value > 0
    axis, above = _touching(tree, pairs)
    # A vertex is looked up by its finer leaf (of equal ones, the first) and the face there.
    vertex_at = np.full((len(tree.level), 6), -1, dtype=np.int32)
    vertex_at[pairs[:, 0], 2 * axis + ~above] = np.arange(len(pairs))
    places = _corners_between(tree, pairs, axis, above)
    corners, sides = in_blocks(
        lambda rows: _polygons_at(tree, inside, vertex_at, places[rows]), len(places), _BLOCK
    )
    used = np.zeros(len(pairs) + 1, dtype=bool)
    used[corners] = True
    used[-1] = False  # the padding of the rows
    number = np.where(used, np.cumsum(used, dtype=np.int32) - 1, np.int32(-1))
    pairs = pairs[used[:-1]]
    leaves = np.where(inside[pairs[:, :1]], pairs, pairs[:, ::-1])
    return Polygons(leaves, number[corners], sides)


def _touching(tree: Octree, pairs: Int[np.ndarray, "K 2"]) -> tuple[np.ndarray, np.ndarray]:
    """The axis along which two leaves touch, and whether the second one lies above (K,)."""
    low, other_low = tree.corner[pairs[:, 0]], tree.corner[pairs[:, 1]]
    size, other_size = (1 << tree.level[pairs].astype(np.int32)).T
    above = other_low == low + size[:, None]
    axis = np.argmax(above | (other_low + other_size[:, None] == low), axis=1)
    return axis, above.any(axis=1)


def _corners_between(
    tree: Octree, pairs: Int[np.ndarray, "K 2"], axis: np.ndarray, above: np.ndarray
) -> Int[np.ndarray, "N"]:
    """The corners of the faces between leaves of opposite sign, each once, by flat index.

    Every dual cube with two signs has its middle at one of them.
    """
    size = 1 << tree.level[pairs[:, 0]].astype(np.int64)
    strides = _strides(tree)
    first = tree.corner[pairs[:, 0]] @ strides + above * size * strides[axis]
    u, v = strides[(axis + 1) % 3] * size, strides[(axis + 2) % 3] * size
    # As `np.unique`, which takes several times as long here.
    ordered = np.sort(np.concatenate([first, first + u, first + v, first + u + v]))
    return ordered[np.append(True, ordered[1:] != ordered[:-1])]


def _strides(tree: Octree) -> Int[np.ndarray, "3"]:
    """What a step along each axis adds to the flat index of a lattice point."""
    _, y, z = (tree.shape.astype(np.int64) << tree.depth) + 1
    return np.array([y * z, z, 1])


def _polygons_at(
    tree: Octree,
    inside: np.ndarray,
    vertex_at: Int[np.ndarray, "L 6"],
    places: Int[np.ndarray, "N"],
) -> tuple[Int[np.ndarray, "P 12"], Int[np.ndarray, "P"]]:
    """Vertices, padded by -1, and sides of the polygons in the dual cubes around lattice points."""
    table = cube_table()
    strides = _strides(tree)
    x, rest = np.divmod(places, strides[0])
    lattice = np.stack([x, *np.divmod(rest, strides[1])], axis=1).astype(np.int32)
    around = tree.locate((lattice[:, None] + _AROUND).reshape(-1, 3)).reshape(-1, 8)
    pattern = np.packbits(inside[around], axis=1, bitorder="little")[:, 0]
    rows = np.flatnonzero(table.count[pattern])
    edges = table.polygons[pattern[rows]]
    drawn = edges[:, :, 0] >= 0
    cube = np.broadcast_to(rows[:, None], drawn.shape)[drawn]
    edges = edges[drawn]
    low, high = np.moveaxis(around[cube[:, None, None], table.edges[edges]], -1, 0)
    size, other = tree.level[low], tree.level[high]
    first = (size < other) | ((size == other) & (low < high))
    face = 2 * (edges // 4) + ~first
    vertices = vertex_at[np.where(first, low, high), face]
    return _drop_repeats(np.where(edges >= 0, vertices, -1))


def _drop_repeats(
    corners: Int[np.ndarray, "P 12"],
) -> tuple[Int[np.ndarray, "Q 12"], Int[np.ndarray, "Q"]]:
    """Merge equal neighbouring corners of polygons, which come from leaves seen twice.

    Polygons left with fewer than three corners are dropped.
    """
    sides = (corners >= 0).sum(axis=1)
    previous = np.roll(corners, 1, axis=1)
    previous[:, 0] = corners[np.arange(len(corners)), sides - 1]
    repeated = (corners >= 0) & (corners == previous)
    rows = np.flatnonzero(repeated.any(axis=1))
    kept = np.where(repeated[rows], -1, corners[rows])
    order = np.argsort(kept < 0, axis=1, kind="stable")
    corners[rows] = np.take_along_axis(kept, order, axis=1)
    sides = sides - repeated.sum(axis=1)
    return corners[sides >= 3], sides[sides >= 3]


def triangulate(
    polygons: Polygons, positions: Float[np.ndarray, "V 3"]
) -> tuple[Int[np.ndarray, "F 3"], Int[np.ndarray, "C"]]:
    """Cut polygons into triangles along short diagonals.

    Where a diagonal would give an edge a third face, the polygon becomes a fan around a new vertex
    in its middle. Returns faces (F, 3) and the polygons (C,) with such a vertex; the new vertices
    are numbered from V on in that order.
    """
    faces, owner = _fans(polygons, positions)
    crowded = np.unique(owner[_on_crowded_edge(faces)])
    # Triangles have no diagonals: only larger polygons can change.
    crowded = crowded[polygons.sides[crowded] > 3]
    if len(crowded) == 0:
        return faces, crowded
    faces = faces[~np.isin(owner, crowded)]
    centre = len(positions) + np.arange(len(crowded))
    corners, sides = polygons.corners[crowded], polygons.sides[crowded]
    column = np.arange(MAX_SIDES)
    following = np.where(column + 1 == sides[:, None], 0, (column + 1) % MAX_SIDES)
    fan = np.stack(
        [
            np.broadcast_to(centre[:, None], corners.shape),
            corners,
            np.take_along_axis(corners, following, axis=1),
        ],
        axis=-1,
    )
    return np.concatenate([faces, fan[column < sides[:, None]]]), crowded


def _fans(
    polygons: Polygons, positions: Float[np.ndarray, "V 3"]
) -> tuple[Int[np.ndarray, "F 3"], Int[np.ndarray, "F"]]:
    """Fan each polygon from the corner whose diagonals are shortest in sum."""
    faces, owner = [], []
    for sides in np.unique(polygons.sides):
        which = np.flatnonzero(polygons.sides == sides)
        corners = polygons.corners[which, :sides]
        if sides > 3:
            at = positions[corners]
            length = np.zeros(corners.shape)
            for i, j in combinations(range(sides), 2):
                if 1 < j - i < sides - 1:
                    diagonal = np.linalg.norm(at[:, i] - at[:, j], axis=1)
                    length[:, i] += diagonal
                    length[:, j] += diagonal
            start = length.argmin(axis=1)
            turned = (start[:, None] + np.arange(sides)) % sides
            corners = np.take_along_axis(corners, turned, axis=1)
        for i in range(1, sides - 1):
            faces.append(corners[:, [0, i, i + 1]])
            owner.append(which)
    return np.concatenate(faces), np.concatenate(owner)


def _on_crowded_edge(faces: Int[np.ndarray, "F 3"]) -> np.ndarray:
    """Whether each face has an edge that more than two faces share, (F,) bool."""
    following = faces[:, [1, 2, 0]]
    key = np.minimum(faces, following).astype(np.int64) * (faces.max() + 1)
    key += np.maximum(faces, following)
    ordered = np.sort(key, axis=None)
    crowded = np.unique(ordered[2:][ordered[2:] == ordered[:-2]])
    if len(crowded) == 0:
        return np.zeros(len(faces), dtype=bool)
    return np.any(np.isin(key, crowded), axis=1)


class CubeTable(NamedTuple):
    """Polygons of each of the 256 sign patterns.

    Corner c of the cube stands at (c >> 2 & 1, c >> 1 & 1, c & 1); bit c of a pattern is set if
    corner c is inside.

    Attributes:
        edges: the two corners of each of the twelve edges (12, 2).
        count: number of polygons (256,).
        polygons: cube edges of each polygon in order, outward, padded by -1 (256, 4, 12).
    """

    edges: Int[np.ndarray, "12 2"]
    count: Int[np.ndarray, "256"]
    polygons: Int[np.ndarray, "256 4 12"]


@lru_cache(maxsize=1)
def cube_table() -> CubeTable:
    """Build the table.

    On a face whose corners alternate, inside corners are cut off one by one, so fingers that nearly
    touch stay apart. This depends on the face alone: two cubes that share it always draw the same
    lines on it, and the surface is closed.
    """
    edges = [(a, a | bit) for bit in (4, 2, 1) for a in range(8) if not a & bit]
    edge_index = {pair: i for i, pair in enumerate(edges)}
    faces = [_face_corners(axis, side) for axis in range(3) for side in range(2)]
    count = np.zeros(256, dtype=np.int64)
    polygons = np.full((256, MAX_POLYGONS, MAX_SIDES), -1, dtype=np.int64)
    for pattern in range(256):
        successor: dict[int, int] = {}
        for corners in faces:
            successor.update(_face_lines(corners, pattern, edge_index))
        while successor:
            start, following = successor.popitem()
            loop = [start]
            while following != start:
                loop.append(following)
                following = successor.pop(following)
            polygons[pattern, count[pattern], : len(loop)] = loop
            count[pattern] += 1
    return CubeTable(np.array(edges), count, polygons)


def _face_corners(axis: int, side: int) -> list[int]:
    """Corners of a face, anticlockwise seen from outside the cube."""
    u, v = 1 << (2 - (axis + 1) % 3), 1 << (2 - (axis + 2) % 3)
    base = (1 << (2 - axis)) * side
    corners = [base, base | u, base | u | v, base | v]
    return corners if side else corners[::-1]


def _face_lines(
    corners: list[int], pattern: int, edge_index: dict[tuple[int, int], int]
) -> dict[int, int]:
    """Lines on one face, from cube edge to cube edge, so that polygons face outwards."""
    lines = {}
    inside = [pattern >> c & 1 for c in corners]
    ends = [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
    edge = [edge_index[min(pair), max(pair)] for pair in ends]
    for i in range(4):
        # Going around the face, the inside is entered across edge i and left across edge j. The
        # line that cuts off these inside corners goes from i to j, so that polygons face outwards.
        if not inside[i] and inside[(i + 1) % 4]:
            j = (i + 1) % 4
            while inside[(j + 1) % 4]:
                j = (j + 1) % 4
            lines[edge[i]] = edge[j]
    return lines
