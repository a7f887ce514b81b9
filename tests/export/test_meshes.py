"""Mesh files: round trips, an independent reader, and failures that leave nothing behind."""

import errno

import numpy as np
import pytest
import trimesh

from xavatar_jax import export
from xavatar_jax.meshing import Mesh


@pytest.fixture
def mesh() -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    vertices = np.asarray(shape.vertices, dtype=np.float32)
    colors = np.random.default_rng(0).integers(0, 256, (len(vertices), 4)).astype(np.uint8)
    return Mesh(vertices, np.asarray(shape.faces), colors=colors).compute_normals()


def test_ply_round_trip(tmp_path, mesh):
    export.write_ply(tmp_path / "m.ply", mesh)
    read = export.read_mesh(tmp_path / "m.ply")
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(read.colors, mesh.colors)


def test_ply_is_read_by_another_library(tmp_path, mesh):
    export.write_ply(tmp_path / "m.ply", mesh)
    other = trimesh.load(tmp_path / "m.ply", process=False)
    np.testing.assert_array_equal(other.faces, mesh.faces)
    np.testing.assert_allclose(other.vertex_normals, mesh.normals, atol=1e-6)
    np.testing.assert_array_equal(other.visual.vertex_colors, mesh.colors)


def test_ply_without_extras(tmp_path, mesh):
    plain = Mesh(mesh.vertices, mesh.faces)
    export.write_ply(tmp_path / "m.ply", plain)
    assert export.read_mesh(tmp_path / "m.ply").colors is None
    body = 12 * mesh.num_vertices + 13 * mesh.num_faces
    size = (tmp_path / "m.ply").stat().st_size
    assert body < size < body + 300


def test_text_ply_and_quads(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    text += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "quad.ply").write_text(text + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n")
    mesh = export.read_mesh(tmp_path / "quad.ply")
    assert mesh.num_vertices == 4
    assert mesh.num_faces == 2
    assert mesh.area == pytest.approx(1)


@pytest.mark.parametrize("normals", [True, False])
def test_obj_round_trip(tmp_path, mesh, normals):
    written = mesh if normals else Mesh(mesh.vertices, mesh.faces)
    export.write_obj(tmp_path / "m.obj", written)
    read = export.read_mesh(tmp_path / "m.obj")
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)


def test_vertices_that_coincide_or_are_unused_are_kept(tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [5, 5, 5]], np.float32)
    mesh = Mesh(vertices, np.array([[0, 1, 2], [3, 1, 2]]))
    for name, write in (("m.ply", export.write_ply), ("m.obj", export.write_obj)):
        write(tmp_path / name, mesh)
        np.testing.assert_array_equal(export.read_mesh(tmp_path / name).vertices, vertices)


def test_unreadable_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.ply"):
        export.read_mesh(tmp_path / "absent.ply")
    for name in ("bad.ply", "bad.obj"):
        (tmp_path / name).write_bytes(b"this is no mesh\n")
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            export.read_mesh(tmp_path / name)


@pytest.mark.parametrize("name", ["m.ply", "m.obj"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_a_failed_write_leaves_what_was_there(tmp_path, mesh, monkeypatch, name, error):
    write = export.write_ply if name.endswith("ply") else export.write_obj
    write(tmp_path / name, mesh)
    before = (tmp_path / name).read_bytes()

    class Broken:
        def __init__(self, file):
            self.file = file

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.file.close()

        def write(self, data):
            self.file.write(data[:10])
            raise error

    import builtins

    real = builtins.open
    monkeypatch.setattr(builtins, "open", lambda *a, **k: Broken(real(*a, **k)))
    with pytest.raises(type(error)):
        write(tmp_path / name, mesh)
    monkeypatch.undo()
    assert (tmp_path / name).read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [name]
