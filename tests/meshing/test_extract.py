"""Level sets of fields whose surfaces are known in closed form."""

import numpy as np
import pytest
from skimage.measure import marching_cubes

from xavatar_jax.geometry import face_normals
from xavatar_jax.meshing import (
    EmptyLevelSetError,
    Mesh,
    connected_components,
    extract_surface,
)

BOUNDS = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]


def ball(centre=(0.0, 0.0, 0.0), radius=0.7):
    return lambda x: radius - np.linalg.norm(x - np.asarray(centre, x.dtype), axis=1)


def torus(x):
    return 0.2 - np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.6, x[:, 2])


def cube(x):
    return 0.5 - np.abs(x).max(axis=1)


def rough(x):
    return np.sin(12 * x[:, 0] * x[:, 1]) + np.sin(17 * x[:, 2] * x[:, 0] + 3 * x[:, 1]) * np.cos(
        23 * x[:, 1]
    )


def edge_uses(mesh: Mesh) -> np.ndarray:
    """Of each directed edge that exists: how often it and its opposite are used, (E, 2)."""
    faces = mesh.faces.astype(np.int64)
    start, end = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    there, back = start * mesh.num_vertices + end, end * mesh.num_vertices + start
    names, counts = np.unique(there, return_counts=True)
    place = np.searchsorted(names, back)
    found = names[np.minimum(place, len(names) - 1)] == back
    return np.stack([counts[np.searchsorted(names, there)], np.where(found, 1, 0)], axis=1)


def assert_closed_manifold(mesh: Mesh) -> None:
    """Every directed edge once, with its opposite: closed, manifold edges, one orientation."""
    np.testing.assert_array_equal(edge_uses(mesh), 1)
    assert len(np.unique(mesh.faces)) == mesh.num_vertices
    # Round every vertex the faces form one ring: splitting it changes nothing.
    corner_of = {}
    for face in mesh.faces:
        for i in range(3):
            corner_of.setdefault(face[i], {})[face[(i + 1) % 3]] = face[(i + 2) % 3]
    for ring in corner_of.values():
        start = node = next(iter(ring))
        steps = 0
        while steps == 0 or node != start:
            node, steps = ring[node], steps + 1
        assert steps == len(ring)


def euler(mesh: Mesh) -> int:
    return mesh.num_vertices - mesh.num_faces * 3 // 2 + mesh.num_faces


def test_sphere():
    mesh = extract_surface(ball(), BOUNDS, cell=0.05)
    assert_closed_manifold(mesh)
    assert euler(mesh) == 2
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.7, atol=1e-5)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=3e-3)
    assert mesh.area == pytest.approx(4 * np.pi * 0.7**2, rel=3e-3)
    centre = mesh.vertices[mesh.faces].mean(axis=1)
    outward = centre / np.linalg.norm(centre, axis=1, keepdims=True)
    assert (face_normals(mesh.vertices, mesh.faces) * outward).sum(axis=1).min() > 0.99


def on_a_full_grid(field, cell: float) -> Mesh:
    """The surface in the bounds by scikit-image (Lewiner et al. 2003)."""
    axis = np.arange(-1, 1 + cell / 2, cell)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = field(points.reshape(-1, 3)).reshape(points.shape[:3])
    vertices, faces, _, _ = marching_cubes(
        values, 0.0, spacing=(cell,) * 3, gradient_direction="ascent"
    )
    return Mesh((vertices - 1).astype(np.float32), faces.astype(np.int32))


def test_agrees_with_marching_cubes_on_a_full_grid():
    graded = extract_surface(torus, BOUNDS, cell=0.04)
    dense = on_a_full_grid(torus, 0.04)
    assert_closed_manifold(dense)
    assert euler(graded) == euler(dense) == 0
    assert graded.volume == pytest.approx(dense.volume, rel=5e-3)
    assert graded.volume == pytest.approx(2 * np.pi**2 * 0.6 * 0.2**2, rel=0.01)
    assert graded.num_vertices == pytest.approx(dense.num_vertices, rel=0.1)


def test_cells_of_different_size_leave_no_crack():
    def cell_at(x):
        return np.where(x[:, 0] > 0.1, 0.02, 0.08)

    mesh = extract_surface(ball(), BOUNDS, cell=0.02, cell_at=cell_at)
    assert_closed_manifold(mesh)
    assert euler(mesh) == 2
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.7, atol=1e-4)
    corners = mesh.vertices[mesh.faces]
    edge = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
    fine, coarse = corners[..., 0].min(axis=1) > 0.3, corners[..., 0].max(axis=1) < -0.4
    assert edge[fine].mean() < 0.025
    assert edge[coarse].mean() > 0.06
    full = extract_surface(ball(), BOUNDS, cell=0.02)
    assert mesh.num_vertices < 0.7 * full.num_vertices


@pytest.mark.parametrize("seed", range(3))
def test_any_octree_and_any_signs_make_a_manifold(seed):
    rng = np.random.default_rng(seed)
    mesh = extract_surface(
        rough,
        BOUNDS,
        cell=0.03,
        cell_at=lambda x: 0.03 * 2.0 ** rng.integers(0, 5, len(x)),
        project_steps=0,
    )
    assert_closed_manifold(mesh)


def test_noise_makes_a_manifold():
    rng = np.random.default_rng(0)
    mesh = extract_surface(
        lambda x: rng.normal(size=len(x)),
        BOUNDS,
        cell=0.2,
        coarse_cell=0.2,
        edge_steps=0,
        project_steps=0,
    )
    assert_closed_manifold(mesh)


def test_exact_zeros_on_the_grid():
    for mesh in (
        extract_surface(cube, BOUNDS, cell=0.0625),
        extract_surface(cube, BOUNDS, cell=0.0625, edge_steps=0, project_steps=0),
        extract_surface(
            lambda x: np.where(np.abs(x).max(axis=1) < 0.5, 1.0, 0.0), BOUNDS, cell=0.1
        ),
    ):
        assert_closed_manifold(mesh)
        assert euler(mesh) == 2
        assert mesh.volume == pytest.approx(1, rel=0.25)


def test_two_close_spheres_stay_apart():
    gap = 0.06

    def field(x):
        left, right = ball((-0.3 - gap / 2, 0, 0), 0.3), ball((0.3 + gap / 2, 0, 0), 0.3)
        return np.maximum(left(x), right(x))

    mesh = extract_surface(field, BOUNDS, cell=0.02)
    assert_closed_manifold(mesh)
    assert connected_components(mesh).max() == 1
    assert mesh.volume == pytest.approx(2 * 4 / 3 * np.pi * 0.3**3, rel=5e-3)


def test_thin_plate():
    def field(x):
        return np.minimum(0.5 - np.abs(x[:, :2]).max(axis=1), 0.02 - np.abs(x[:, 2]))

    mesh = extract_surface(field, BOUNDS, cell=0.02)
    assert_closed_manifold(mesh)
    assert euler(mesh) == 2
    assert mesh.volume == pytest.approx(0.04, rel=0.03)


def test_a_thin_finger_is_followed_from_the_palm():
    def field(x):
        along = np.clip(x[:, 0], 0.0, 0.8)
        finger = 0.015 - np.linalg.norm(x - along[:, None] * [1.0, 0, 0], axis=1)
        return np.maximum(ball(radius=0.3)(x), finger)

    mesh = extract_surface(field, BOUNDS, cell=0.01, coarse_cell=0.16, max_vertices=None)
    assert mesh.bounds[1, 0] == pytest.approx(0.815, abs=0.005)


def test_seeds_find_a_separate_piece_that_coarse_cells_miss():
    def field(x):
        return np.maximum(ball((-0.4, 0, 0), 0.3)(x), ball((0.53, 0.21, 0.17), 0.03)(x))

    without = extract_surface(field, BOUNDS, cell=0.01, coarse_cell=0.16)
    seeds = np.array([[0.56, 0.21, 0.17], [0.53, 0.24, 0.17]])
    found = extract_surface(field, BOUNDS, cell=0.01, coarse_cell=0.16, seeds=seeds)
    assert connected_components(without).max() == 0
    assert connected_components(found).max() == 1
    assert found.largest_component().num_vertices == without.num_vertices


def test_a_surface_is_closed_at_the_bounds():
    mesh = extract_surface(lambda x: 0.3 - np.abs(x[:, 2]), BOUNDS, cell=0.05)
    assert_closed_manifold(mesh)
    assert np.abs(mesh.vertices).max() <= 1
    assert mesh.volume == pytest.approx(2 * 2 * 0.6, rel=0.03)


def test_every_call_has_the_same_shape_and_type():
    seen = set()

    def field(x):
        seen.add(("field", x.shape, x.dtype))
        return ball()(x)

    def gradient(x):
        seen.add(("gradient", x.shape, x.dtype))
        return -x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)

    sizes = {"cell": 0.1, "batch_points": 1000, "normals": True}
    mesh = extract_surface(field, BOUNDS, gradient=gradient, **sizes)
    shape = ((1000, 3), np.dtype(np.float32))
    assert seen == {("field", *shape), ("gradient", *shape)}
    plain = extract_surface(field, BOUNDS, **sizes)
    np.testing.assert_allclose(mesh.vertices, plain.vertices, atol=2e-3)
    np.testing.assert_allclose(mesh.normals, plain.normals, atol=5e-3)


def test_level_and_normals():
    mesh = extract_surface(ball(), BOUNDS, cell=0.1, level=0.2, normals=True)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.5, atol=1e-4)
    np.testing.assert_allclose(mesh.normals, mesh.vertices / 0.5, atol=1e-2)


def test_steep_fields_are_projected_too():
    # Like a trained occupancy: a logit that saturates a few millimetres from the surface.
    mesh = extract_surface(lambda x: 20 * np.tanh(40 * ball()(x)), BOUNDS, cell=0.05)
    error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.7)
    assert error.mean() < 1e-4
    assert error.max() < 2e-3


def test_triangles_are_well_shaped():
    mesh = extract_surface(ball(), BOUNDS, cell=0.04)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert (sides.min(axis=1) / sides.max(axis=1)).min() > 0.3


def test_max_vertices_holds():
    mesh = extract_surface(ball(), BOUNDS, cell=0.01, max_vertices=5_000)
    assert 4_000 < mesh.num_vertices <= 5_000
    assert_closed_manifold(mesh)
    graded = extract_surface(
        ball(),
        BOUNDS,
        cell=0.01,
        cell_at=lambda x: np.where(x[:, 0] > 0, 0.01, 0.04),
        max_vertices=5_000,
    )
    assert 3_500 < graded.num_vertices <= 5_000


def test_empty_level_sets_say_what_was_seen():
    with pytest.raises(EmptyLevelSetError, match=r"Everything seen is outside.*seeds"):
        extract_surface(lambda x: np.full(len(x), -3.0), BOUNDS, cell=0.1)
    with pytest.raises(EmptyLevelSetError, match=r"3 to 3.*Everything is inside"):
        extract_surface(lambda x: np.full(len(x), 3.0), BOUNDS, cell=0.1)
    assert issubclass(EmptyLevelSetError, ValueError)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cell": 0.0}, "cell must be a positive length"),
        ({"bounds": [[0, 0, 0], [1, 1, -1]]}, "enclose a volume"),
        ({"bounds": [0, 1]}, r"shape \(2, 3\), found \(2,\)"),
        ({"field": lambda x: x}, r"with shape \(64,\), found \(64, 3\)"),
        ({"field": lambda x: np.full(len(x), np.nan)}, "not finite"),
        ({"cell_at": lambda x: np.zeros(len(x))}, "positive lengths"),
        ({"coarse_cell": 0.01}, "must not be below cell"),
        ({"max_vertices": 3}, "16 or more"),
        ({"seeds": np.zeros((3, 2))}, r"seeds must have shape \(N, 3\)"),
        ({"batch_points": 0}, "batch_points must be 1 or more"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    arguments = {"field": ball(), "bounds": BOUNDS, "cell": 0.2, "batch_points": 64}
    with pytest.raises(ValueError, match=message):
        extract_surface(**{**arguments, **change})
