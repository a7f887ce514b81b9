"""The triangle mesh that meshing makes and that metrics, export and render take."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, Shaped

from ..geometry import check_mesh, enclosed_volume, face_areas, vertex_normals


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in metres, faces anticlockwise seen from outside.

    Attributes:
        vertices: positions (V, 3), metres.
        faces: vertex indices (F, 3), int32.
        normals: optional unit vertex normals (V, 3).
        colors: optional vertex colours (V, 3) or (V, 4), uint8.

    Raises:
        ValueError: if the arrays' shapes do not fit each other, or a face names no vertex.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    # "_": `__post_init__` compares the counts, and names the array.
    normals: Float[np.ndarray, "_ 3"] | None = None
    colors: Shaped[np.ndarray, "_ C"] | None = None

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices)
        if vertices.dtype.kind != "f":
            vertices = vertices.astype(np.float32)
        check_mesh(vertices, self.faces)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", np.asarray(self.faces, dtype=np.int32))
        count = len(vertices)
        if self.normals is not None:
            normals = np.asarray(self.normals)
            if normals.shape != (count, 3):
                raise ValueError(f"normals must have shape ({count}, 3), found {normals.shape}.")
            object.__setattr__(self, "normals", normals)
        if self.colors is not None:
            colors = np.asarray(self.colors)
            if colors.shape not in ((count, 3), (count, 4)) or colors.dtype != np.uint8:
                raise ValueError(
                    f"colors must be uint8 of shape ({count}, 3) or ({count}, 4), found "
                    f"{colors.dtype} {colors.shape}."
                )
            object.__setattr__(self, "colors", colors)

    @property
    def num_vertices(self) -> int:
        """Number of vertices V."""
        return len(self.vertices)

    @property
    def num_faces(self) -> int:
        """Number of faces F."""
        return len(self.faces)

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lowest and highest corner of the axis-aligned box, metres."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def area(self) -> float:
        """Surface area, square metres."""
        return float(face_areas(self.vertices, self.faces).sum())

    @property
    def volume(self) -> float:
        """Enclosed volume, cubic metres; positive if the faces point outwards."""
        return enclosed_volume(self.vertices, self.faces)

    def compute_normals(self) -> "Mesh":
        """The same mesh with area-weighted vertex normals."""
        normals = vertex_normals(self.vertices, self.faces)
        return replace(self, normals=normals.astype(self.vertices.dtype))

    def largest_component(self) -> "Mesh":
        """The connected piece with the largest area, unused vertices dropped."""
        labels = connected_components(self)
        if labels.max() == 0:
            return self
        areas = face_areas(self.vertices, self.faces)
        face_labels = labels[self.faces[:, 0]]
        return self.keep_faces(face_labels == np.bincount(face_labels, areas).argmax())

    def keep_faces(self, mask: np.ndarray) -> "Mesh":
        """The mesh of the faces where `mask` (F,) is true, unused vertices dropped.

        Raises:
            ValueError: if no face is kept.
        """
        faces = self.faces[mask]
        used = np.zeros(self.num_vertices, dtype=bool)
        used[faces.reshape(-1)] = True
        renumbered = np.cumsum(used) - 1
        return Mesh(
            self.vertices[used],
            renumbered[faces],
            None if self.normals is None else self.normals[used],
            None if self.colors is None else self.colors[used],
        )


def connected_components(mesh: Mesh) -> Int[np.ndarray, "V"]:
    """Label each vertex with the number of its connected piece, from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components as components

    start = mesh.faces.reshape(-1)
    end = mesh.faces[:, [1, 2, 0]].reshape(-1)
    size = (mesh.num_vertices, mesh.num_vertices)
    graph = coo_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=size)
    return components(graph, directed=False)[1]
