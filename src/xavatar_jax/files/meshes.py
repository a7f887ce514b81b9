"""Reading a triangle mesh from a file, with vertices in the order of the file.

PLY and OBJ files are read here: general readers split and reorder vertices at texture seams, and
miss variants that are in use. Other formats are read by trimesh.
"""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from .limits import DEFAULT_LIMITS, Budget, read_bytes
from .pickles import load_pickle

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")


def read_mesh(
    path: str | os.PathLike[str],
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Read vertices and triangles without merging, splitting or reordering vertices.

    Labels and skinning weights refer to vertices by index. Polygons become triangles.

    Args:
        path: a PLY, OBJ, GLB, STL or OFF file, or a pickle of arrays `vertices` and `faces`, as
            X-Humans has them for scans.

    Returns:
        Vertices, float32, in the units of the file; triangles as vertex indices, int32.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a mesh that can be read, has no vertices or no triangles, or
            holds values that are not finite. The message names the file.
    """
    vertices, faces, _ = read_colored_mesh(path)
    return vertices, faces


def read_colored_mesh(
    path: str | os.PathLike[str],
) -> tuple[
    Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"], UInt8[np.ndarray, "V channels"] | None
]:
    """As `read_mesh`, with the vertex colours of a PLY file (three or four channels) if any."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"No mesh file at {path}.")
    suffix, colors = path.suffix.lower(), None
    if suffix not in (*MESH_SUFFIXES, ".pkl"):
        raise ValueError(
            f"{path}: cannot read a mesh from a {path.suffix or 'suffix-less'} file; "
            f"readable are {', '.join(MESH_SUFFIXES)}, .pkl."
        )
    if suffix == ".pkl":
        vertices, faces = _pickled_mesh(path)
    else:
        try:
            if suffix == ".obj":
                vertices, faces = _read_obj(read_bytes(path, DEFAULT_LIMITS))
            elif suffix == ".ply":
                vertices, faces, colors = _read_ply(read_bytes(path, DEFAULT_LIMITS))
            else:
                vertices, faces = _read_other(path)
        except OSError:
            raise
        except (Exception, RecursionError) as error:  # damaged bytes can fail anywhere
            said = str(error) or type(error).__name__
            raise ValueError(f"{path}: not a readable mesh ({said}).") from error
    with np.errstate(over="ignore"):  # what overflows float32 is not finite, as reported below
        vertices = vertices.astype(np.float32)
    check_mesh(vertices, faces, str(path))
    return vertices, faces.astype(np.int32), colors


def _read_other(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    loaded = trimesh.load_mesh(path, process=False)
    vertices = np.asarray(getattr(loaded, "vertices", ()), np.float64).reshape(-1, 3)
    return vertices, np.asarray(getattr(loaded, "faces", ()), np.int64).reshape(-1, 3)


def _pickled_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = load_pickle(path)
    missing = [n for n in ("vertices", "faces") if not isinstance(data, dict) or n not in data]
    if missing:
        held = ", ".join(map(str, data)) if isinstance(data, dict) else type(data).__name__
        raise ValueError(f"{path}: no {' and no '.join(missing)}; it holds {held}.")
    for name, kinds in (("vertices", "iuf"), ("faces", "iu")):
        value = data[name]
        if not isinstance(value, np.ndarray) or value.dtype.kind not in kinds:
            found = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
            what = "numbers" if name == "vertices" else "whole numbers"
            raise ValueError(f"{path}: {name} holds {found}, expected an array of {what}.")
    return data["vertices"], data["faces"]


def _triangles(polygons: list[list[int]]) -> np.ndarray:
    """Triangles of polygons, as fans around their first corners."""
    return np.array(
        [(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)], np.int64
    ).reshape(-1, 3)


# OBJ


def _read_obj(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    text = data.decode("utf-8", errors="replace")
    text = re.sub(r"\\[ \t]*\r?\n", " ", text)
    numbers: list[str] = []
    polygons: list[list[int]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if words[0] == "v":
            if len(words) < 4:
                raise ValueError(f"line {number}: a vertex with {len(words) - 1} coordinates")
            numbers += words[1:4]
        elif words[0] == "f":
            # Texture and normal indices follow slashes. Negative indices count backwards from the
            # vertices so far.
            try:
                corners = [int(word.partition("/")[0]) for word in words[1:]]
            except ValueError:
                raise ValueError(f"line {number}: a face {' '.join(words[1:])[:60]!r}") from None
            if len(corners) < 3 or 0 in corners:
                raise ValueError(f"line {number}: a face {' '.join(words[1:])[:60]!r}")
            count = len(numbers) // 3
            polygons.append([c - 1 if c > 0 else count + c for c in corners])
    return _parsed(" ".join(numbers), len(numbers)).reshape(-1, 3), _triangles(polygons)


def _parsed(text: str | bytes, count: int) -> np.ndarray:
    """Numbers of a text, as many as there are words in it."""
    try:
        numbers = np.fromstring(text, np.float64, sep=" ") if count else np.zeros(0)
    except ValueError:
        raise ValueError("a word where a number should be") from None
    if len(numbers) != count:
        raise ValueError(f"number {len(numbers) + 1} of {count} cannot be read")
    return numbers


# PLY

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4",
    "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Element:
    """An element of a PLY file.

    Attributes:
        name: of the element.
        count: number of entries.
        properties: name, type, and type of the length for lists, of each property.
    """

    name: str
    count: int
    properties: list[tuple[str, str, str | None]]


def _read_ply(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    order, elements, start = _ply_header(data)
    budget = Budget(DEFAULT_LIMITS, len(data))
    if order == "":
        text = data[start:]
        count = len(text.split())
        budget.spend(8 * count)
        read, place = _ascii_element, 0
        source: np.ndarray | bytes = _parsed(text, count)
    else:
        read, place, source = _binary_element, start, data
    columns: dict[str, dict[str, np.ndarray | list]] = {}
    for element in elements:
        columns[element.name], place = read(source, place, element, order)  # type: ignore[operator]
        if {"vertex", "face"} <= columns.keys():
            break
    vertex, face = columns.get("vertex", {}), columns.get("face", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise ValueError("no vertices with x, y and z")
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    corners = next((face[name] for name in _CORNERS if name in face), None)
    if corners is None:
        faces = np.zeros((0, 3), np.int64)
    elif isinstance(corners, np.ndarray):
        faces = _fans(corners.astype(np.int64))
    else:
        faces = _triangles(corners)
    return vertices, faces, _ply_colors(vertex)


def _fans(corners: np.ndarray) -> np.ndarray:
    """Triangles of polygons that have the same number of corners."""
    if corners.shape[1] < 3:
        return np.zeros((0, 3), np.int64)
    fans = [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
    return np.stack(fans, axis=1).reshape(-1, 3)


def _ply_colors(vertex: dict[str, np.ndarray | list]) -> np.ndarray | None:
    names = [n for n in ("red", "green", "blue", "alpha") if n in vertex]
    if len(names) < 3 or names[:3] != ["red", "green", "blue"]:
        return None
    values = np.stack([np.asarray(vertex[name]) for name in names], axis=1)
    if values.dtype.kind == "f":
        values = np.nan_to_num(np.clip(values, 0, 1)) * 255 + 0.5
    return np.clip(values, 0, 255).astype(np.uint8)


def _ply_header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ("" for text), elements, and where the data begin."""
    end = re.search(rb"\bend_header[ \t]*(\r\n|\n|\r)", data[:1_000_000])
    if data[:3] != b"ply" or end is None:
        raise ValueError("no PLY header")
    order: str | None = None
    elements: list[_Element] = []
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", name, *_] if name in _FORMATS:
                order = _FORMATS[name]
            case ["element", name, count] if count.isdigit() and len(count) < 12:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= {
                *_TYPES
            }:
                elements[-1].properties.append((name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind], None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"a line of the PLY header is not understood: {line[:60]!r}")
    if order is None:
        raise ValueError("the PLY header names no format")
    return order, elements, end.end()


def _binary_element(
    data: bytes, place: int, element: _Element, order: str
) -> tuple[dict[str, np.ndarray | list], int]:
    """Columns of an element and where the next one begins."""
    lengths = _first_lengths(data, place, element, order)
    fields: list = []
    for index, ((name, kind, length), count) in enumerate(
        zip(element.properties, lengths, strict=True)
    ):
        if length is not None:
            fields.append((f"{index}", f"{order}{length}"))
        fields.append((f"{index}:{name}", f"{order}{kind}", () if length is None else (count,)))
    row = np.dtype(fields)
    size = row.itemsize * element.count
    if place + size <= len(data):
        rows = np.frombuffer(data, row, element.count, place) if size else np.zeros(0, row)
        same = all(
            (rows[f"{index}"] == count).all()
            for index, ((_, _, length), count) in enumerate(
                zip(element.properties, lengths, strict=True)
            )
            if length is not None
        )
        if same:
            columns = {p[0]: rows[f"{i}:{p[0]}"] for i, p in enumerate(element.properties)}
            return columns, place + size  # pyright: ignore[reportReturnType]
    if all(length is None for _, _, length in element.properties):
        raise _short(element)
    return _binary_rows(data, place, element, order)


def _first_lengths(data: bytes, place: int, element: _Element, order: str) -> list[int]:
    """Lengths of the lists of an element's first entry, 0 for single numbers."""
    lengths = []
    for _, kind, length in element.properties:
        count = 0
        if length is not None:
            code = struct.Struct((order or "<") + _code(length))
            if element.count and place + code.size <= len(data):
                count = int(code.unpack_from(data, place)[0])
            if not 0 <= count <= len(data):
                raise ValueError(f"a list of {count} numbers in element {element.name!r}")
            place += code.size
        place += np.dtype(kind).itemsize * (1 if length is None else count)
        lengths.append(count)
    return lengths


def _code(kind: str) -> str:
    """The `struct` code of a NumPy type, of the same size on every platform."""
    return {"i8": "q", "u8": "Q"}.get(kind, np.dtype(kind).char)


def _binary_rows(
    data: bytes, place: int, element: _Element, order: str
) -> tuple[dict[str, np.ndarray | list], int]:
    """Columns of an element whose lists differ in length, one entry after another."""
    readers = [
        (
            name,
            _code(kind),
            None if length is None else struct.Struct(order + _code(length)),
        )
        for name, kind, length in element.properties
    ]
    columns: dict[str, list] = {name: [] for name, _, _ in readers}
    for _ in range(element.count):
        for name, kind, length in readers:
            count = 1
            if length is not None:
                if place + length.size > len(data):
                    raise _short(element)
                count = int(length.unpack_from(data, place)[0])
                place += length.size
            size = struct.calcsize(order + kind) * count
            if count < 0 or place + size > len(data):
                raise _short(element)
            values = struct.unpack_from(f"{order}{count}{kind}", data, place)
            place += size
            columns[name].append(values[0] if length is None else list(values))
    return dict(columns), place


def _ascii_element(
    numbers: np.ndarray, place: int, element: _Element, order: str
) -> tuple[dict[str, np.ndarray | list], int]:
    """As `_binary_element`, of the numbers of a text."""
    del order
    starts, lengths, width = [], [], 0  # of the first entry
    for _, _, length in element.properties:
        starts.append(width + (length is not None))
        lengths.append(0 if length is None else _length(numbers, place + width, element))
        width += 1 if length is None else 1 + lengths[-1]
    end = place + width * element.count
    if end <= len(numbers):
        table = numbers[place:end].reshape(element.count, width)
        same = all(
            (table[:, start - 1] == length).all()
            for start, length, p in zip(starts, lengths, element.properties, strict=True)
            if p[2] is not None
        )
        if same:
            columns: dict[str, np.ndarray | list] = {}
            for start, length, p in zip(starts, lengths, element.properties, strict=True):
                part = table[:, start] if p[2] is None else table[:, start : start + length]
                columns[p[0]] = part if np.dtype(p[1]).kind == "f" else part.astype(np.int64)
            return columns, end
    rows: dict[str, list] = {name: [] for name, _, _ in element.properties}
    for _ in range(element.count):
        for name, _, length in element.properties:
            count = 1 if length is None else _length(numbers, place, element)
            place += length is not None
            values = numbers[place : place + count].astype(np.int64).tolist()
            if len(values) != count:
                raise _short(element)
            place += count
            rows[name].append(values[0] if length is None else values)
    return dict(rows), place


def _length(numbers: np.ndarray, place: int, element: _Element) -> int:
    """The length of a list in a text."""
    if element.count == 0:
        return 0
    if place >= len(numbers):
        raise _short(element)
    if not 0 <= numbers[place] <= len(numbers):
        raise ValueError(f"a list of {numbers[place]:g} numbers in element {element.name!r}")
    return int(numbers[place])


def _short(element: _Element) -> ValueError:
    return ValueError(f"the file ends inside its {element.count} entries {element.name!r}")


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
