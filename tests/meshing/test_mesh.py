"""The mesh record."""

import numpy as np
import pytest
import trimesh

from xavatar_jax.meshing import Mesh


def two_boxes() -> Mesh:
    big = trimesh.creation.box(extents=(2.0, 1.0, 1.0))
    # More faces, less area: the largest piece is the one with the most area.
    small = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    small.apply_translation((3, 0, 0))
    both = trimesh.util.concatenate([small, big])
    colors = np.zeros((len(both.vertices), 3), np.uint8)
    colors[-8:] = 200
    return Mesh(np.asarray(both.vertices), np.asarray(both.faces), colors=colors)


def test_largest_component_is_by_area_and_keeps_colours():
    mesh = two_boxes().compute_normals().largest_component()
    assert mesh.num_vertices == 8
    assert mesh.num_faces == 12
    assert mesh.volume == pytest.approx(2)
    assert mesh.area == pytest.approx(10)
    np.testing.assert_allclose(mesh.bounds, [[-1, -0.5, -0.5], [1, 0.5, 0.5]])
    assert (mesh.colors == 200).all()
    assert mesh.normals.shape == (8, 3)


def test_unused_vertices_do_not_count_as_pieces():
    mesh = Mesh(np.array([[9.0, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[1, 2, 3]]))
    assert mesh.largest_component().num_vertices == 3


def test_wrong_arrays_are_named():
    vertices, faces = np.zeros((3, 3)), np.array([[0, 1, 2]])
    with pytest.raises(ValueError, match=r"normals must have shape \(3, 3\), found \(2, 3\)"):
        Mesh(vertices, faces, normals=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"colors must be uint8 .* found float64 \(3, 3\)"):
        Mesh(vertices, faces, colors=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="empty"):
        Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
