"""Part grids: linear functions, continuity across borders, slopes, cover; and skinning on them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ArmField, arm_transforms, central_difference
from scipy.spatial import cKDTree

from xavatar_jax.fields import (
    GridSpacing,
    MLPShape,
    MLPSkinning,
    TabulatedSkinning,
    build_part_grids,
    pose_grid,
    skin_with_jacobian,
    tabulate,
)
from xavatar_jax.fields.grids import lerp_weights
from xavatar_jax.kinematics import KinematicTree, skin_points

SPACING = GridSpacing(body=0.02, hands=0.005, face=0.01, band=0.06, fine_band=0.03, margin=1.5)
# float32 places of nodes: a metre has 1e-7, over a cell of 5 mm.
READ = 5e-5


# Compiled once a shape: one operation after another would compile each of them.
interpolate = eqx.filter_jit(lambda grids, values, x: grids.interpolate(values, x))
slopes = eqx.filter_jit(
    lambda grids, values, x: jax.vmap(jax.jacfwd(lambda p: grids.interpolate(values, p)))(x)
)
covers = eqx.filter_jit(lambda grids, x: grids.covers(x))
locate = eqx.filter_jit(lambda grids, x: grids.locate(x))
blend = eqx.filter_jit(lambda grids, values: grids.blend(values))
read = eqx.filter_jit(lambda field, x: jax.vmap(field)(x))


def stick_figure(rng):
    """A trunk of radius 8 cm with a ball for a hand at its end, and a face on its side."""
    trunk = rng.normal(size=(1500, 3))
    trunk *= 0.08 / np.linalg.norm(trunk, axis=1, keepdims=True)
    trunk[:, 0] = rng.uniform(-0.3, 0.25, 1500)
    hand = rng.normal(size=(400, 3))
    hand *= 0.03 / np.linalg.norm(hand, axis=1, keepdims=True)
    hand[:, 0] += 0.3
    face = rng.uniform(-0.02, 0.02, (200, 3)) + np.array([-0.2, 0.1, 0.0])
    labels = np.repeat([0, 2, 1], [1500, 400, 200])
    return np.concatenate([trunk, hand, face]), labels


@pytest.fixture(scope="module")
def figure():
    return stick_figure(np.random.default_rng(0))


@pytest.fixture(scope="module")
def grids(figure):
    vertices, labels = figure
    return build_part_grids(
        vertices, labels, SPACING,
        fine_parts={"hand": ((2,), SPACING.hands), "face": ((1, 4), SPACING.face),
                    "absent": ((3,), 0.001)},
    )  # fmt: skip


@pytest.fixture(scope="module")
def inside(grids, figure):
    """Points near the surface, all covered."""
    rng = np.random.default_rng(1)
    vertices, _ = figure
    points = vertices[rng.integers(0, len(vertices), 3000)] + 0.012 * rng.normal(size=(3000, 3))
    points = jnp.asarray(points, jnp.float32)
    covered = covers(grids, points)
    assert covered.mean() > 0.99
    return points[covered]


def boxes(grids):
    for g in range(1, len(grids.spacing)):
        low = np.asarray(grids.origin[g], np.float64)
        yield low, low + np.asarray(grids.shape[g]) * float(grids.spacing[g])


def test_layout(grids):
    assert grids.origin.shape == (3, 3)  # a part without vertices has no grid
    np.testing.assert_allclose(grids.spacing, [0.02, 0.005, 0.01], rtol=1e-6)
    # Fine boxes are aligned with coarse cells.
    for low, high in boxes(grids):
        for corner in (low, high):
            cells = (corner - np.asarray(grids.origin[0])) / 0.02
            np.testing.assert_allclose(cells, np.round(cells), atol=1e-3)
    assert grids.num_nodes == len(grids.nodes)
    assert grids.cells.min() >= 0
    assert grids.cells.max() < grids.num_nodes


def test_spacing_is_rounded_down_to_a_fraction_of_the_coarse_one(figure):
    vertices, labels = figure
    made = build_part_grids(vertices, labels, SPACING, fine_parts={"hand": ((2,), 0.007)})
    np.testing.assert_allclose(made.spacing, [0.02, 0.02 / 3], rtol=1e-6)


def test_vertices_are_covered_and_far_points_are_not(grids, figure):
    vertices, labels = figure
    assert bool(covers(grids, jnp.asarray(vertices, jnp.float32)).all())
    far = jnp.array([[5.0, 0, 0], [0, 0.35, 0], [-0.6, 0, 0], [0.0, 0.0, -9.0]])
    assert not bool(covers(grids, far).any())
    assert not bool(covers(grids, jnp.full(3, jnp.nan)))
    # Whoever asks there still gets numbers: those of the nearest stored cell.
    assert np.isfinite(interpolate(grids, grids.nodes, far)).all()
    # Points inside each fine box are read from its own, finer cells.
    _, _, spacing = locate(grids, jnp.asarray(vertices[labels == 2], jnp.float32))
    np.testing.assert_allclose(spacing, 0.005, rtol=1e-6)


@pytest.mark.parametrize("blended", [False, True])
def test_linear_functions_come_back_exactly(grids, inside, rng, blended):
    slope, shift = rng.normal(size=(3, 4)), rng.normal(size=4)
    linear = lambda p: jnp.asarray(p) @ jnp.asarray(slope, jnp.float32) + shift  # noqa: E731
    values = linear(grids.nodes)
    values = blend(grids, values) if blended else values
    np.testing.assert_allclose(interpolate(grids, values, inside), linear(inside), atol=2e-6)
    gradient = slopes(grids, values, inside)
    expected = np.broadcast_to(slope.T, gradient.shape)
    np.testing.assert_allclose(gradient, expected, atol=1e-3)  # float32 differences over 5 mm


def random_values(grids, rng, columns=3):
    """Different at every node, to the size of one: nothing smooth to hide a jump."""
    return jnp.asarray(rng.normal(size=(grids.num_nodes, columns)), jnp.float32)


def test_no_jump_across_the_borders_of_fine_boxes(grids, rng):
    """A step of a micrometre across a face changes random values by a step's worth, no more."""
    blended, raw = [], []
    values = random_values(grids, rng)
    smooth = blend(grids, values)
    for low, high in boxes(grids):
        for axis in range(3):
            for side in (low, high):
                on_face = rng.uniform(low, high, (400, 3))
                on_face[:, axis] = side[axis]
                step = 1e-6 * np.eye(3)[axis]
                before = jnp.asarray(on_face - step, jnp.float32)
                after = jnp.asarray(on_face + step, jnp.float32)
                both = np.asarray(covers(grids, before) & covers(grids, after))
                for jumps, v in ((blended, smooth), (raw, values)):
                    jump = jnp.abs(interpolate(grids, v, before) - interpolate(grids, v, after))
                    jumps.append(np.asarray(jump.max(-1))[both])
    blended, raw = np.concatenate(blended), np.concatenate(raw)
    assert len(blended) > 200
    assert np.median(raw) > 0.1  # without blending there are jumps of the values' own size
    # A step of 2e-6 m through slopes of up to a few units over 5 mm, and float32 places.
    assert blended.max() < 5e-3


def test_the_coarse_grid_answers_beyond_the_fine_band(grids, figure, rng):
    """In the hand's box, 4 to 6 cm from the hand: covered, and as the coarse grid has it."""
    low, high = next(boxes(grids))
    points = rng.uniform(low, high, (20_000, 3))
    away = cKDTree(figure[0]).query(points)[0]
    points = jnp.asarray(points[(away > 0.045) & (away < 0.06)], jnp.float32)
    assert len(points) > 500
    assert covers(grids, points).all()
    cell, fraction, spacing = locate(grids, points)
    np.testing.assert_allclose(spacing, SPACING.body, rtol=1e-6)
    corner = np.asarray(grids.nodes)[np.asarray(grids.cells)[np.asarray(cell), 0]]
    np.testing.assert_allclose(corner + SPACING.body * np.asarray(fraction), points, atol=1e-6)


def test_no_jump_where_the_fine_band_ends(grids, figure, rng):
    """Along rays out of the hand, a micrometre at a time where grids change."""
    values = random_values(grids, rng)
    smooth = blend(grids, values)
    low, high = next(boxes(grids))
    start = figure[0][figure[1] == 2]
    way = rng.normal(size=start.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    reach = np.linspace(0.0, 0.05, 200)
    rays = start[:, None] + reach[:, None] * way[:, None]
    spacing = np.asarray(locate(grids, jnp.asarray(rays, jnp.float32))[2])
    inside = ((rays > low + 0.001) & (rays < high - 0.001)).all(-1)
    change = (np.diff(spacing, axis=1) != 0) & inside[:, 1:] & inside[:, :-1]
    ray, at = np.nonzero(change)
    assert len(ray) > 50
    # Halving: the last place of the one grid and the first of the other.
    near, far = rays[ray, at], rays[ray, at + 1]
    first = spacing[ray, at]
    for _ in range(12):
        middle = 0.5 * (near + far)
        same = np.asarray(locate(grids, jnp.asarray(middle, jnp.float32))[2]) == first
        near, far = np.where(same[:, None], middle, near), np.where(same[:, None], far, middle)
    near, far = jnp.asarray(near, jnp.float32), jnp.asarray(far, jnp.float32)
    both = np.asarray(covers(grids, near) & covers(grids, far))
    jumps = [
        np.asarray(jnp.abs(interpolate(grids, v, near) - interpolate(grids, v, far)).max(-1))[both]
        for v in (smooth, values)
    ]
    assert np.median(jumps[1]) > 0.1
    assert jumps[0].max() < 5e-3


def test_no_jump_between_cells_of_one_grid(grids, inside, rng):
    values = blend(grids, random_values(grids, rng))
    points = np.asarray(inside, np.float64)
    cell, _, spacing = locate(grids, inside)
    step = np.asarray(spacing)[:, None] * 1e-3 * rng.normal(size=points.shape)
    moved = jnp.asarray(points + step, jnp.float32)
    both = np.asarray(covers(grids, moved))
    change = np.abs(interpolate(grids, values, moved) - interpolate(grids, values, inside)).max(-1)
    crossed = np.asarray(locate(grids, moved)[0] != cell)
    # A thousandth of a cell changes values by a few thousandths of their range, crossing or not.
    assert (crossed & both).sum() > 5
    assert change[both].max() < 0.05


def test_blending_leaves_nodes_far_inside_alone(grids, figure, rng):
    values = random_values(grids, rng)
    blended = blend(grids, values)
    changed = np.asarray(jnp.any(blended != values, -1))
    nodes = np.asarray(grids.nodes)
    near_border = np.zeros(len(nodes), bool)
    for low, high in boxes(grids):
        depth = np.minimum(nodes - low, high - nodes).min(1)
        near_border |= (depth > -1e-5) & (depth < SPACING.margin * SPACING.body + 1e-5)
    # Within half a coarse cell of where the fine band ends, which is 3 cm and a cell at least.
    away = cKDTree(figure[0]).query(nodes)[0]
    near_border |= away > SPACING.fine_band - SPACING.fine_margin * SPACING.body - 0.01
    assert changed.any()
    assert not changed[~near_border].any()
    share = np.asarray(grids.blend_share)
    assert changed[np.asarray(grids.blend_nodes)[share > 0.01]].all()


def test_slopes_agree_with_differences(grids, inside, rng):
    values = blend(grids, random_values(grids, rng))
    _, fraction, spacing = locate(grids, inside)
    well_inside = np.asarray(jnp.all((fraction > 0.1) & (fraction < 0.9), -1))
    points = np.asarray(inside)[well_inside][:300]
    h = 0.05 * np.asarray(spacing)[well_inside][:300, None]
    slope = slopes(grids, values, jnp.asarray(points))
    scale = np.abs(slope).max()
    for axis in range(3):
        step = h * np.eye(3, dtype=np.float32)[axis]
        up = interpolate(grids, values, jnp.asarray(points + step))
        down = interpolate(grids, values, jnp.asarray(points - step))
        # A trilinear function is linear along an axis: the difference is exact.
        difference = (up - down) / (2 * h)
        np.testing.assert_allclose(slope[..., axis], difference, atol=2e-3 * scale)


def test_interpolation_weights_of_a_cell(x64, rng):
    fraction = rng.uniform(size=(20, 3))
    weights = np.asarray(lerp_weights(jnp.asarray(fraction)))
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-14)
    np.testing.assert_allclose(weights @ corners, fraction, atol=1e-14)


@pytest.fixture(scope="module")
def mlp_field():
    tree = KinematicTree(("a", "b", "c"), (-1, 0, 1))
    shape = MLPShape(width=16, depth=2, octaves=0, skip=(), condition_at=())
    return MLPSkinning(tree, shape, soft_blend=3.0, key=jax.random.key(5))


@pytest.fixture(scope="module")
def table(grids, mlp_field):
    return tabulate(mlp_field, grids, chunk=1000)


def some_transforms(rng, count=3, spread=0.5):
    from scipy.spatial.transform import Rotation

    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(spread * rng.normal(size=(count, 3))).as_matrix()
    out[:, :3, 3] = 0.1 * rng.normal(size=(count, 3))
    return jnp.asarray(out, jnp.float32)


def test_a_table_holds_the_fields_values_at_the_nodes(grids, mlp_field, table):
    expected = np.array(read(mlp_field, grids.nodes))
    own = np.setdiff1d(np.arange(grids.num_nodes), np.asarray(grids.blend_nodes))
    np.testing.assert_allclose(table.node_weights[own], expected[own], atol=1e-6)
    np.testing.assert_allclose(table.node_weights.sum(1), 1.0, atol=1e-5)


def test_a_table_reads_close_to_a_smooth_field(mlp_field, table, inside):
    found, expected = read(table, inside), read(mlp_field, inside)
    assert np.abs(found - expected).max() < 5e-3  # h^2/8 times the field's curvature


def test_blending_transforms_commutes_with_interpolation(table, inside, rng):
    """Twelve numbers a node, or weights first: the same point."""
    transforms = some_transforms(rng)
    grid = pose_grid(table, transforms)
    points, _ = read(grid, inside)
    expected = skin_points(inside, read(table, inside), transforms)
    np.testing.assert_allclose(points, expected, atol=2e-6)


def test_the_jacobian_of_a_posed_grid_is_that_of_its_map(table, inside, rng):
    transforms = some_transforms(rng)
    grid = pose_grid(table, transforms)
    _, fraction, _ = locate(table.grids, inside)
    points = inside[jnp.all((fraction > 0.05) & (fraction < 0.95), -1)][:200]
    _, found = read(grid, points)
    automatic = jax.jit(jax.vmap(jax.jacfwd(lambda x: grid(x)[0])))(points)
    np.testing.assert_allclose(found, automatic, atol=5e-4)
    by_field = jax.jit(jax.vmap(lambda x: skin_with_jacobian(table, x, transforms)[1]))(points)
    np.testing.assert_allclose(found, by_field, atol=5e-4)


def test_skinning_jacobian_agrees_with_differences(x64, rng):
    field, transforms = ArmField(jnp.asarray(12.0)), arm_transforms(1.1, (0.1, -0.2, 0.3))
    map_ = jax.jit(lambda v: skin_points(v, field(v), transforms))
    run = jax.jit(lambda v: skin_with_jacobian(field, v, transforms))
    for x in 0.1 * rng.normal(size=(5, 3)):
        posed, jacobian, weights = run(x)
        np.testing.assert_allclose(posed, map_(x), atol=1e-14)
        np.testing.assert_allclose(weights, field(jnp.asarray(x)), rtol=1e-12)
        np.testing.assert_allclose(jacobian, central_difference(map_, x), atol=1e-8)


def test_cover_of_a_table_is_that_of_its_grids(table, inside):
    assert bool(jax.vmap(table.covers)(inside).all())
    assert not bool(table.covers(jnp.array([3.0, 0, 0])))


def test_tables_and_grids_under_jit_and_grad(table, inside, rng):
    transforms = some_transforms(rng)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(table: TabulatedSkinning):
        points, _ = jax.vmap(pose_grid(table, transforms))(inside[:50])
        return jnp.sum(points**2)

    gradient = slope(table).node_weights
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0
