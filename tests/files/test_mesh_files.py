"""Mesh files as other programs write them, written here byte by byte."""

from __future__ import annotations

import pickle
import struct

import numpy as np
import pytest
import trimesh

from xavatar_jax.files.meshes import read_colored_mesh, read_mesh

CORNERS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE = [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    "text",
    [
        CORNERS + "f 1 2 3\nf\t1\t3\t4\n",
        CORNERS.replace("v ", "v\t") + "f\t1 2  3\n  f 1 3 4",
        CORNERS + "f 1 2 3 # front\nf 1 3 4#back\n",
        CORNERS + "f 1 2 \\\n3\nf \\\r\n1 3 4\n",
        CORNERS.replace("\n", "\r\n") + "f 1 2 3\r\nf 1 3 4\r\n",
        CORNERS + "vn 0 0 1\nvt 0 0\nf 1/1/1 2/1/1 3/1/1\nf 1//1 3//1 4//1\n",
        CORNERS + "f -4 -3 -2\nf -4 -2 -1\n",
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 -2 -1\n",
        CORNERS + "usemtl \xe9\no part\ng x\ns 1\nf 1 2 3 4\n",
        CORNERS.replace("0 0\n", "0 0 0.5 0.5 0.5\n") + "f 1 2 3 4\nl 1 2\n",
    ],
)
def test_obj_in_all_its_spellings(tmp_path, text):
    path = tmp_path / "mesh.obj"
    path.write_bytes(text.encode("latin-1"))
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert faces.tolist() == SQUARE
    assert (vertices.dtype, faces.dtype) == (np.float32, np.int32)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (CORNERS + "f 1 2\n", "line 5: a face '1 2'"),
        (CORNERS + "f 1 2 x\n", "line 5: a face"),
        (CORNERS + "f 0 1 2\n", "line 5: a face"),
        (CORNERS + "f 1 2 9\n", "vertex 8"),
        (CORNERS + "f -9 1 2\n", "lowest -5"),
        ("v 0 0\nf 1 1 1\n", "line 1: a vertex with 2 coordinates"),
        ("v 0 0 a\nf 1 1 1\n", "a word where a number should be"),
        ("v 0 0 1e999\nf 1 1 1\n", "1 of 1 vertices are not finite"),
        ("v 0 0 1e300\nf 1 1 1\n", "1 of 1 vertices are not finite"),
        (CORNERS, "no triangles"),
        ("", "no vertices"),
    ],
)
def test_what_is_wrong_with_an_obj_is_named(tmp_path, text, words):
    path = tmp_path / "odd.obj"
    path.write_text(text)
    with pytest.raises(ValueError, match=words) as error:
        read_mesh(path)
    assert "odd.obj" in str(error.value)


def ply(path, form, faces, *, kinds=("float", "uchar", "int"), colors=None, extra=False):
    """A PLY file of the square and a tip, with polygons of any size."""
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)]
    real, length, index = kinds
    head = ["ply", f"format {form} 1.0", "comment made here"]
    if extra:
        head += ["element camera 1", "property float view", "property list uchar short ids"]
    head += ["element vertex 5", *(f"property {real} {axis}" for axis in "xyz")]
    head += [f"property uchar {c}" for c in ("red", "green", "blue")] if colors else []
    head += [f"element face {len(faces)}", f"property list {length} {index} vertex_indices"]
    head += (
        ["property list uchar float texcoord", "end_header", ""] if extra else ["end_header", ""]
    )
    codes = {
        "float": "f", "double": "d", "uchar": "B", "ushort": "H", "int": "i", "uint": "I",
        "uint64": "Q",
    }  # fmt: skip
    order = ">" if "big" in form else "<"
    out = []  # rows of (value, code)
    if extra:
        out.append([(2.5, "f"), (2, "B"), (7, "h"), (8, "h")])
    for k, point in enumerate(points):
        row = [(x, codes[real]) for x in point]
        out.append(row + ([(c, "B") for c in colors[k]] if colors else []))
    for face in faces:
        row = [(len(face), codes[length]), *((v, codes[index]) for v in face)]
        out.append(row + ([(2, "B"), (0.25, "f"), (0.5, "f")] if extra else []))
    data = "\n".join(head).encode()
    if form == "ascii":
        data += "\n".join(" ".join(str(v) for v, _ in row) for row in out).encode()
    else:
        data += b"".join(struct.pack(order + c, v) for row in out for v, c in row)
    path.write_bytes(data)
    return path


FORMS = ["ascii", "binary_little_endian", "binary_big_endian"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize(
    "kinds", [("float", "uchar", "int"), ("double", "int", "uint"), ("float", "ushort", "uint64")]
)
@pytest.mark.parametrize(
    ("faces", "expected"),
    [
        ([[0, 1, 4], [1, 2, 4]], [[0, 1, 4], [1, 2, 4]]),
        ([[0, 1, 4], [0, 1, 2, 3]], [[0, 1, 4], *SQUARE]),
        ([[0, 1, 2, 3], [0, 1, 4]], [*SQUARE, [0, 1, 4]]),
        ([[0, 1, 2, 3], [3, 2, 1, 0]], [*SQUARE, [3, 2, 1], [3, 1, 0]]),
    ],
)
def test_ply_with_polygons_of_any_size(tmp_path, form, extra, kinds, faces, expected):
    path = ply(tmp_path / "mesh.ply", form, faces, kinds=kinds, extra=extra)
    vertices, found = read_mesh(path)
    assert found.tolist() == expected
    np.testing.assert_array_equal(vertices[4], [0.5, 0.5, 1])


@pytest.mark.parametrize("form", FORMS)
def test_ply_colors(tmp_path, form):
    colors = [(k, 2 * k, 250 + k) for k in range(5)]
    path = ply(tmp_path / "mesh.ply", form, [[0, 1, 4]], colors=colors)
    np.testing.assert_array_equal(read_colored_mesh(path)[2], colors)
    assert read_colored_mesh(ply(tmp_path / "plain.ply", form, [[0, 1, 4]]))[2] is None


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off", "glb"])
def test_files_of_another_library(tmp_path, suffix):
    sphere = trimesh.creation.icosphere(2)
    sphere.export(tmp_path / f"mesh.{suffix}")
    vertices, faces = read_mesh(tmp_path / f"mesh.{suffix}")
    np.testing.assert_allclose(vertices[faces], sphere.triangles, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_damaged_ply_files_are_named(tmp_path, form):
    whole = ply(tmp_path / "a.ply", form, [[0, 1, 4], [0, 1, 2, 3]]).read_bytes()
    start = whole.index(b"end_header")
    path = tmp_path / "odd.ply"
    for length in range(0, len(whole) - 1, 3):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"odd\.ply"):
            read_mesh(path)
    for old, new, words in (
        (b"element vertex 5", b"element vertex 99999999999", "ends inside its 99999999999"),
        (b"element face 2", b"element face 99999", "ends inside its 99999 entries"),
        (b"property float y\n", b"", "x, y and z|ends inside"),
        (b"format", b"formed", "not understood"),
        (b"float x", b"number x", "not understood"),
        (b"vertex_indices", b"strips", "no triangles"),
    ):
        path.write_bytes(whole[:start].replace(old, new) + whole[start:])
        with pytest.raises(ValueError, match=words) as error:
            read_mesh(path)
        assert "odd.ply" in str(error.value)


def test_pickled_scans_hold_numbers(tmp_path):
    path = tmp_path / "scan.pkl"
    good = {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]], np.int64)}
    path.write_bytes(pickle.dumps(good))
    assert read_mesh(path)[1].tolist() == [[0, 1, 2]]
    for change, words in (
        ({"vertices": np.array(["a"])}, "vertices holds <U1, expected an array of numbers"),
        ({"vertices": [[0, 1, 2]]}, "vertices holds list"),
        ({"faces": np.zeros((1, 3))}, "faces holds float64, expected an array of whole numbers"),
        ({"faces": np.array([[0, 1, 3]])}, "vertex 3"),
        ({"vertices": np.full((3, 3), 1e200)}, "3 of 3 vertices are not finite"),
        ({"vertices": np.eye(3) + 1j}, "complex128"),
    ):
        path.write_bytes(pickle.dumps(good | change))
        with pytest.raises(ValueError, match=words) as error:
            read_mesh(path)
        assert "scan.pkl" in str(error.value)
