"""Reading a triangle mesh from a file, vertices in the file's own order."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from .unpickle import load_pickle

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")

_KEEP_ORDER = {"process": False, "maintain_order": True, "skip_materials": True}


def read_mesh(path: str | Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Read vertices and triangles, merging, splitting and reordering nothing.

    Vertex order matters: labels and skinning weights refer to it. Polygons become triangles.

    Args:
        path: a PLY, OBJ, GLB, STL or OFF file, or a pickle of arrays `vertices` and `faces`, as
            the scans of X-Humans are.

    Returns:
        Vertices, float32, in the units of the file; triangles as vertex indices, int32.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no mesh we can read, has no vertices or no triangles, or holds
            values that are not finite.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No mesh file at {path}.")
    if path.suffix.lower() == ".pkl":
        return _pickled_mesh(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ValueError(
            f"{path}: cannot read a mesh from a {path.suffix or 'suffix-less'} file; "
            f"readable are {', '.join(MESH_SUFFIXES)}, .pkl."
        )
    try:
        if path.suffix.lower() == ".obj":
            loaded = trimesh.load_mesh(_obj_geometry(path), file_type="obj", **_KEEP_ORDER)
        else:
            # Texture coordinates of a PLY file would split and reorder vertices, too.
            whole = {"fix_texture": False} if path.suffix.lower() == ".ply" else {}
            loaded = trimesh.load_mesh(path, process=False, **whole)
    except Exception as error:
        # trimesh raises whatever its parsers raise: one readable error instead.
        raise ValueError(
            f"{path}: not a readable mesh ({type(error).__name__}: {error})."
        ) from error
    vertices = np.asarray(getattr(loaded, "vertices", ()), np.float32).reshape(-1, 3)
    faces = np.asarray(getattr(loaded, "faces", ()), np.int32).reshape(-1, 3)
    check_mesh(vertices, faces, str(path))
    return vertices, faces


def _pickled_mesh(path: Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    data = load_pickle(path)
    missing = [n for n in ("vertices", "faces") if not isinstance(data, dict) or n not in data]
    if missing:
        held = ", ".join(map(str, data)) if isinstance(data, dict) else type(data).__name__
        raise ValueError(f"{path}: no {' and no '.join(missing)}; it holds {held}.")
    vertices, faces = np.asarray(data["vertices"], np.float32), np.asarray(data["faces"])
    check_mesh(vertices, faces, str(path))
    return vertices, faces.astype(np.int32)


def _obj_geometry(path: Path) -> io.StringIO:
    """The `v` and `f` lines of an OBJ file alone, without texture and normal indices.

    With materials or texture seams in the file, trimesh would split and reorder vertices.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    kept = [line for line in text.splitlines() if line.lstrip().startswith(("v ", "v\t", "f "))]
    return io.StringIO(re.sub(r"(-?\d+)/\S*", r"\1", "\n".join(kept)) + "\n")


def check_mesh(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], source: str
) -> None:
    """Raise `ValueError`, naming `source`, unless vertices and triangles make a usable mesh."""
    if vertices.ndim != 2 or vertices.shape[-1] != 3:
        raise ValueError(f"{source}: vertices have shape {vertices.shape}, expected (V, 3).")
    if faces.ndim != 2 or faces.shape[-1] != 3:
        raise ValueError(f"{source}: faces have shape {faces.shape}, expected (F, 3) triangles.")
    if len(vertices) == 0:
        raise ValueError(f"{source}: the mesh has no vertices.")
    if len(faces) == 0:
        raise ValueError(f"{source}: the mesh has no triangles (a point cloud?).")
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices)).any(axis=1).sum())
        raise ValueError(f"{source}: {bad} of {len(vertices)} vertices are not finite.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"{source}: faces refer to vertex {int(faces.max())} (lowest {int(faces.min())}), "
            f"but there are {len(vertices)} vertices."
        )
