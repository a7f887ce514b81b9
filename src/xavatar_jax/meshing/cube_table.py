"""Which polygons a level set draws in a cube, from the signs at the cube's eight corners."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

MAX_POLYGONS, MAX_SIDES = 4, 12


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

    On a face whose corners alternate, inside corners are cut off one by one. That depends on the
    face alone, so two cubes that share a face always draw the same lines on it, and the surface
    is closed. Two fingers that nearly touch stay apart.
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
        # Walking round the face we enter the inside across edge i and leave it across edge j:
        # the line that cuts off this run of inside corners goes from where we enter to where we
        # leave, so that polygons face the outside of the solid.
        if not inside[i] and inside[(i + 1) % 4]:
            j = (i + 1) % 4
            while inside[(j + 1) % 4]:
                j = (j + 1) % 4
            lines[edge[i]] = edge[j]
    return lines
