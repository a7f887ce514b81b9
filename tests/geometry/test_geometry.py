"""Mesh queries against shapes whose answers are known in closed form."""

import numpy as np
import pytest
import trimesh

from xavatar_jax import geometry


@pytest.fixture(scope="module")
def box():
    mesh = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=4)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def box_distance(points):
    """Unsigned distance to the surface of the box [-1, 1]^3."""
    q = np.abs(points) - 1.0
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
    return np.abs(outside + np.minimum(q.max(axis=1), 0.0))


def test_winding_number_of_a_box(box):
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (5000, 3))
    points = points[np.abs(np.abs(points).max(axis=1) - 1) > 1e-3]
    winding = geometry.winding_number(*box, points)
    np.testing.assert_array_equal(winding > 0.5, np.abs(points).max(axis=1) < 1)


def test_winding_number_of_nested_pieces_is_inside(box):
    vertices, faces = box
    both = np.concatenate([vertices, 0.5 * vertices])
    nested = np.concatenate([faces, faces + len(vertices)])
    winding = geometry.winding_number(both, nested, [[0.0, 0, 0], [0.8, 0, 0], [1.2, 0, 0]])
    np.testing.assert_allclose(winding, [2, 1, 0], atol=0.02)


def test_winding_number_survives_a_hole(sphere):
    vertices, faces = sphere
    open_faces = faces[vertices[faces].mean(axis=1)[:, 2] < 0.9]
    winding = geometry.winding_number(vertices, open_faces, [[0.0, 0, 0], [0, 0, -1.5]])
    assert winding[0] > 0.5 > winding[1]


def test_winding_number_without_the_reusable_tree(box, monkeypatch):
    import igl

    points = np.random.default_rng(0).uniform(-1.5, 1.5, (200, 3))
    with_tree = geometry.winding_number(*box, points)
    monkeypatch.delattr(igl, "FastWindingNumberBVH")
    np.testing.assert_allclose(geometry.winding_number(*box, points), with_tree, atol=1e-6)


def test_closest_points_of_a_box(box):
    points = np.random.default_rng(1).uniform(-2, 2, (2000, 3))
    distance, face, point = geometry.closest_points(*box, points)
    np.testing.assert_allclose(distance, box_distance(points), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - point, axis=1), distance, atol=1e-12)
    corner = box[0][box[1][face, 0]]
    normal = geometry.face_normals(*box)[face]
    np.testing.assert_allclose(np.sum((point - corner) * normal, axis=1), 0, atol=1e-12)


def test_no_queries_give_no_answers(box):
    nothing = np.zeros((0, 3))
    assert geometry.winding_number(*box, nothing).shape == (0,)
    assert geometry.closest_points(*box, nothing).point.shape == (0, 3)


def test_nearest_vertices_equal_brute_force(sphere):
    points = np.random.default_rng(2).normal(size=(300, 3))
    distance, index = geometry.nearest_vertices(sphere[0], points)
    table = np.linalg.norm(points[:, None] - sphere[0][None], axis=2)
    np.testing.assert_allclose(distance, table.min(axis=1), atol=1e-12)
    np.testing.assert_array_equal(index, table.argmin(axis=1))


def test_areas_normals_and_volume(box, sphere):
    assert geometry.face_areas(*box).sum() == pytest.approx(24.0)
    assert geometry.enclosed_volume(*box) == pytest.approx(8.0)
    assert geometry.enclosed_volume(box[0] + 100.0, box[1][:, ::-1]) == pytest.approx(-8.0)
    vertices, faces = sphere
    assert geometry.enclosed_volume(vertices, faces) == pytest.approx(4 / 3 * np.pi, rel=5e-3)
    np.testing.assert_allclose(geometry.vertex_normals(vertices, faces), vertices, atol=1e-2)
    centre = vertices[faces].mean(axis=1)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    np.testing.assert_allclose(geometry.face_normals(vertices, faces), centre, atol=1e-2)


def test_degenerate_triangle_has_a_zero_normal():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]])
    np.testing.assert_array_equal(geometry.face_normals(vertices, [[0, 1, 2]]), [[0, 0, 0]])
    np.testing.assert_array_equal(geometry.vertex_normals(vertices, [[0, 1, 2]])[3], 0)


def test_samples_are_uniform_by_area_and_on_their_faces():
    # Areas 1 and 3, coplanar.
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0], [-2, 0, 0], [0, -3, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    points, face = geometry.sample_surface(vertices, faces, 40_000, 0)
    assert np.mean(face == 1) == pytest.approx(0.75, abs=0.01)
    np.testing.assert_allclose(points[face == 0].mean(axis=0), [2 / 3, 1 / 3, 0], atol=0.01)
    first = points[face == 0]
    assert (first.min(axis=0) >= 0).all()
    assert (first[:, 0] / 2 + first[:, 1] <= 1 + 1e-12).all()
    again, _ = geometry.sample_surface(vertices, faces, 40_000, np.random.default_rng(0))
    np.testing.assert_array_equal(points, again)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], r"shape \(N, 3\), found \(3, 2\)"),
        (np.zeros((3, 3)), [[0, 1, 3]], "vertices 0 to 3, but the mesh has 3"),
        (np.zeros((3, 3)), [[0, 1, 2, 2]], "Triangulate"),
        (np.zeros((3, 3)), np.zeros((0, 3), int), "empty"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "row 0"),
    ],
)
def test_bad_meshes_are_named(vertices, faces, message):
    for query in (geometry.closest_points, geometry.winding_number):
        with pytest.raises(ValueError, match=message):
            query(vertices, faces, np.zeros((1, 3)))


def test_samples_of_nothing_are_refused():
    with pytest.raises(ValueError, match="without area"):
        geometry.sample_surface(np.zeros((3, 3)), [[0, 1, 2]], 5, 0)
