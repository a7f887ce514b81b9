"""The surface between leaves of an octree: marching cubes on the octree's dual grid.

Every corner where leaves meet is the middle of a dual cube whose corners are the centres of the
eight leaves around it (a large leaf may be several of them). Dual cubes fill space without gaps
whatever the sizes of the leaves, so marching cubes on them is closed and manifold, with no rule
for cracks. A surface vertex lies between two face-adjacent leaves of opposite sign and is named
by them.

Source: Schaefer and Warren 2004, "Dual marching cubes: primal contouring of dual grids".
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .cube_table import MAX_SIDES, cube_table
from .octree import Octree

_AROUND = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=np.int64) - 1


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
    """Polygons of the surface between the leaf `pairs` of opposite sign."""
    table = cube_table()
    around = _leaves_around(tree, np.unique(pairs))
    pattern = ((tree.value[around] > 0) << np.arange(8)).sum(axis=1)
    rows = np.flatnonzero(table.count[pattern])
    edges = table.polygons[pattern[rows]]
    drawn = edges[:, :, 0] >= 0
    cube = np.broadcast_to(rows[:, None], drawn.shape)[drawn]
    edges = edges[drawn]

    ends = around[cube[:, None, None], table.edges[edges]]
    inside = tree.value[ends[..., 0]] > 0
    first = np.where(inside, ends[..., 0], ends[..., 1])
    second = np.where(inside, ends[..., 1], ends[..., 0])
    key = np.where(edges >= 0, first * len(tree.level) + second, -1)
    key, sides = _drop_repeats(key)
    key, sides = key[sides >= 3], sides[sides >= 3]
    names, corners = np.unique(key, return_inverse=True)
    corners = corners.reshape(key.shape)
    if len(names) and names[0] < 0:
        names, corners = names[1:], corners - 1
    leaves = np.stack(np.divmod(names, len(tree.level)), axis=1)
    return Polygons(leaves, corners, sides)


def _leaves_around(tree: Octree, leaves: Int[np.ndarray, "M"]) -> Int[np.ndarray, "N 8"]:
    """The eight leaves around each lattice corner of `leaves`, each lattice corner once."""
    size = 1 << tree.level[leaves].astype(np.int64)
    corner = tree.corner[leaves].astype(np.int64)[:, None] + size[:, None, None] * (_AROUND + 1)
    extent = (tree.shape << tree.depth) + 1
    flat = (corner[..., 0] * extent[1] + corner[..., 1]) * extent[2] + corner[..., 2]
    flat = np.unique(flat)
    lattice = np.stack(
        [flat // (extent[1] * extent[2]), flat // extent[2] % extent[1], flat % extent[2]], axis=1
    )
    found = tree.locate((lattice[:, None] + _AROUND).reshape(-1, 3))
    return found.reshape(-1, 8).astype(np.int64)


def _drop_repeats(
    key: Int[np.ndarray, "P 12"],
) -> tuple[Int[np.ndarray, "P 12"], Int[np.ndarray, "P"]]:
    """Merge neighbouring equal corners of each polygon; they come from leaves seen twice."""
    sides = (key >= 0).sum(axis=1)
    column = np.arange(MAX_SIDES)
    previous = np.where(column == 0, sides[:, None] - 1, column - 1)
    keep = (key >= 0) & (key != np.take_along_axis(key, previous, axis=1))
    order = np.argsort(~keep, axis=1, kind="stable")
    key = np.take_along_axis(np.where(keep, key, -1), order, axis=1)
    return key, keep.sum(axis=1)


def triangulate(
    polygons: Polygons, positions: Float[np.ndarray, "V 3"]
) -> tuple[Int[np.ndarray, "F 3"], Int[np.ndarray, "C"]]:
    """Cut polygons into triangles along short diagonals.

    Where a diagonal would be a third face's edge, the polygon becomes a fan round a new vertex in
    its middle instead. Returns faces (F, 3) and the polygons (C,) that have such a vertex; the
    new vertices are numbered from V on in that order.
    """
    faces, owner = _fans(polygons, positions)
    crowded = np.unique(owner[_on_crowded_edge(faces)])
    # Triangles have no diagonals: only larger polygons can give way.
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
            length = np.linalg.norm(at[:, :, None] - at[:, None], axis=-1)
            # A corner's two polygon edges stay: only what is left of each row is diagonals.
            step = np.abs(np.subtract.outer(np.arange(sides), np.arange(sides)))
            diagonal = (step > 1) & (step < sides - 1)
            start = (length * diagonal).sum(axis=2).argmin(axis=1)
            turned = (start[:, None] + np.arange(sides)) % sides
            corners = np.take_along_axis(corners, turned, axis=1)
        for i in range(1, sides - 1):
            faces.append(corners[:, [0, i, i + 1]])
            owner.append(which)
    return np.concatenate(faces), np.concatenate(owner)


def _on_crowded_edge(faces: Int[np.ndarray, "F 3"]) -> np.ndarray:
    """Whether each face has an edge that more than two faces share, (F,) bool."""
    ends = np.sort(np.stack([faces, faces[:, [1, 2, 0]]], axis=-1), axis=-1).astype(np.int64)
    key = ends[..., 0] * (faces.max() + 1) + ends[..., 1]
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.any(count[inverse.reshape(key.shape)] > 2, axis=1)
