"""Edges, manifoldness and normals of triangle meshes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


class Edges:
    """Unique undirected edges of a mesh and the faces at them.

    pairs: (E, 2) with the smaller index first; of_face: (F, 3), edge k of a face joins corners k
    and k + 1; count: (E,) number of faces at an edge. If every edge has two, half: (E, 2) are its
    flat indices into `of_face`, faces: (E, 2) those faces, and opposite: (E, 2) the vertex of each
    that is not on the edge.
    """

    def __init__(self, faces: Int[np.ndarray, "F 3"]):
        n = int(faces.max()) + 1
        a = faces.ravel()
        b = faces[:, [1, 2, 0]].ravel()
        code = np.minimum(a, b).astype(np.int64) * n + np.maximum(a, b)
        unique, first, inverse, self.count = np.unique(
            code, return_index=True, return_inverse=True, return_counts=True
        )
        self.pairs = np.stack([unique // n, unique % n], 1)
        self.of_face = inverse.reshape(-1, 3)
        last = np.zeros(len(unique), dtype=np.int64)
        last[inverse] = np.arange(len(inverse))
        self.half = np.stack([first, last], 1)
        self.faces = self.half // 3
        corner = (self.half % 3 + 2) % 3
        self.opposite = faces[self.faces, corner]


def bad_edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "E 2"]:
    """Edges that are not shared by exactly two faces of consistent orientation."""
    edges = Edges(faces)
    a, b = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    sense = np.bincount(
        edges.of_face.ravel(), weights=np.where(a < b, 1.0, -1.0), minlength=len(edges.pairs)
    )
    return edges.pairs[(edges.count != 2) | (sense != 0)]


def split_fans(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "V2 3"], Int[np.ndarray, "F 3"]]:
    """Duplicate vertices so that each has a single fan of faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = Edges(faces)
    corner = np.arange(faces.size).reshape(-1, 3)
    rows, cols = [], []
    # Corners of the two faces at the same end of an edge belong to one fan.
    f, k = edges.faces, edges.half % 3
    for end in (0, 1):
        left = corner[f[:, 0], (k[:, 0] + end) % 3]
        right = corner[f[:, 1], (k[:, 1] + 1 - end) % 3]
        rows.append(left)
        cols.append(right)
    r, c = np.concatenate(rows), np.concatenate(cols)
    graph = coo_matrix((np.ones(len(r)), (r, c)), shape=(faces.size, faces.size))
    _, fan = connected_components(graph, directed=False)
    _, first, new = np.unique(fan, return_index=True, return_inverse=True)
    return vertices[faces.ravel()[first]], new.reshape(-1, 3)


def vertex_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Area-weighted unit normals, outwards."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for i in range(3):
        for d in range(3):
            normals[:, d] += np.bincount(faces[:, i], area[:, d], minlength=len(vertices))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
