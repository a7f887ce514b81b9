"""PLY and OBJ files. Vertices keep their order and number in both directions."""

import os

import numpy as np

from ..files import atomic_path
from ..files.meshes import read_mesh as read_arrays
from ..meshing import Mesh


def write_ply(path: str | os.PathLike[str], mesh: Mesh) -> None:
    """Write a binary PLY with float32 vertices, and normals and colours if the mesh has them.

    Metres in, metres out. The file appears whole or not at all.

    Raises:
        OSError: if the file cannot be written; what stood there before stays.
    """
    fields: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    columns = [mesh.vertices.T]
    if mesh.normals is not None:
        fields += [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
        columns.append(mesh.normals.T)
    if mesh.colors is not None:
        names = ("red", "green", "blue", "alpha")[: mesh.colors.shape[1]]
        fields += [(name, "u1") for name in names]
        columns.append(mesh.colors.T)
    rows = np.empty(mesh.num_vertices, dtype=fields)
    for (name, _), column in zip(fields, (c for block in columns for c in block), strict=True):
        rows[name] = column
    corners = np.empty(mesh.num_faces, dtype=[("count", "u1"), ("corner", "<i4", 3)])
    corners["count"], corners["corner"] = 3, mesh.faces
    kinds = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {mesh.num_vertices}",
        *(f"property {kinds[kind]} {name}" for name, kind in fields),
        f"element face {mesh.num_faces}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(rows.tobytes())
        file.write(corners.tobytes())


def write_obj(path: str | os.PathLike[str], mesh: Mesh) -> None:
    """Write an OBJ with vertices and faces, and normals if the mesh has them.

    Colours follow the coordinates on the vertex lines, as MeshLab and Blender read them. The file
    appears whole or not at all.

    Raises:
        OSError: if the file cannot be written; what stood there before stays.
    """
    vertices, form = mesh.vertices, "v %.7g %.7g %.7g"
    if mesh.colors is not None:
        vertices = np.concatenate([vertices, mesh.colors[:, :3] / 255.0], axis=1)
        form += " %.4g %.4g %.4g"
    faces = mesh.faces + 1
    with atomic_path(path) as temporary, open(temporary, "w", encoding="ascii") as file:
        np.savetxt(file, vertices, fmt=form)
        if mesh.normals is None:
            np.savetxt(file, faces, fmt="f %d %d %d")
        else:
            np.savetxt(file, mesh.normals, fmt="vn %.6g %.6g %.6g")
            np.savetxt(file, np.repeat(faces, 2, axis=1), fmt="f %d//%d %d//%d %d//%d")


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a PLY (text or binary), OBJ or other mesh file; polygons become triangles.

    Vertex colours are read from PLY files that have them.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file holds no triangle mesh; the message names the file.
    """
    name = os.fspath(path)
    vertices, faces = read_arrays(name)
    return Mesh(vertices, faces, colors=_ply_colors(name, len(vertices)))


def _ply_colors(path: str, count: int) -> np.ndarray | None:
    """Vertex colours (V, 4) of a PLY file that has them."""
    if not path.lower().endswith(".ply"):
        return None
    import trimesh

    visual = trimesh.load_mesh(path, process=False, fix_texture=False).visual
    if visual is None or visual.kind != "vertex":
        return None
    colors = np.asarray(visual.vertex_colors, dtype=np.uint8)  # pyright: ignore
    return colors if colors.shape == (count, 4) else None
