"""PLY and OBJ files, and folders of them. Reading and writing keep the order of vertices."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from ..files import atomic_folder, atomic_path
from ..files.meshes import read_colored_mesh
from ..meshing import Mesh

SequenceFormat = Literal["ply", "obj"]
"""File formats of mesh sequences."""


def write_ply(path: str | os.PathLike[str], mesh: Mesh) -> None:
    """Write a binary PLY with float32 vertices, in metres, and normals and colours if present.

    **Raises:** `OSError` if the file cannot be written; an existing file is kept.
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
    """Write an OBJ with vertices, faces, and normals and colours if present.

    Colours follow the coordinates on vertex lines, which MeshLab and Blender read.

    **Raises:** `OSError` if the file cannot be written; an existing file is kept.
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
    """Read a PLY (text or binary, with vertex colours), OBJ or other mesh file.

    Polygons are split into triangles.

    **Raises:** `FileNotFoundError` if there is no such file; `ValueError` naming the file if it
    holds no triangle mesh.
    """
    vertices, faces, colors = read_colored_mesh(os.fspath(path))
    return Mesh(vertices, faces, colors=colors)


def write_sequence(
    folder: str | os.PathLike[str],
    meshes: Iterable[Mesh],
    count: int,
    *,
    format: SequenceFormat | str = "ply",
    done: Callable[[int], Any] = lambda frames: None,
) -> list[str]:
    """Write `count` meshes (metres) into a new folder as `frame_0000.ply` and so on.

    Returns their paths; calls `done(1)` after each frame. The folder appears when it is complete.

    **Raises:** `FileExistsError` if `folder` exists; `ValueError` for an unknown format; `OSError`
    if it cannot be written.
    """
    if format not in get_args(SequenceFormat):
        raise ValueError(f"unknown format {format!r}: {', '.join(get_args(SequenceFormat))}")
    target = Path(folder)
    if target.exists():
        raise FileExistsError(f"{target}: already exists; name a new folder, or remove this one")
    write = {"ply": write_ply, "obj": write_obj}[format]
    digits = max(4, len(str(count - 1)))
    names = []
    with atomic_folder(target) as temporary:
        for k, mesh in enumerate(meshes):
            names.append(f"frame_{k:0{digits}d}.{format}")
            write(temporary / names[-1], mesh)
            done(1)
    return [str(target / name) for name in names]
