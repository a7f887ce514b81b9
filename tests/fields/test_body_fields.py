"""Fields made for a body: the template's weights on grids, and the local geometry field."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from xavatar_jax.body import (
    BodyParams,
    canonical_expression_dirs,
    canonical_joints,
    canonical_params,
    pose_body,
)
from xavatar_jax.fields import (
    ExpressionGrid,
    GridSpacing,
    HashGeometry,
    body_part_grids,
    grid_vertices,
    template_expression,
    template_grid_skinning,
    template_weights,
)

COARSE = GridSpacing(body=0.04, hands=0.013, face=0.02, band=0.08, fine_band=0.03)


@pytest.fixture(scope="module")
def vertices(bundled_body):
    return grid_vertices(bundled_body)


@pytest.fixture(scope="module")
def skinning(bundled_body, vertices):
    return template_grid_skinning(bundled_body, vertices, COARSE, COARSE, smoothing_steps=2)


def test_weights_at_the_vertices_are_their_own(bundled_body, vertices, rng):
    pick = rng.integers(0, len(vertices), 300)
    found = template_weights(bundled_body, vertices, vertices[pick])
    np.testing.assert_allclose(found, bundled_body.weights[pick], atol=1e-4)
    np.testing.assert_allclose(found.sum(1), 1.0, atol=1e-5)


def test_grids_are_laid_in_float64(bundled_body, vertices):
    """Cells are the same on every machine only if no float32 decides which are taken."""
    posed = np.asarray(pose_body(bundled_body, canonical_params(bundled_body)).vertices)
    assert vertices.dtype == np.float64
    assert (vertices != vertices.astype(np.float32)).mean() > 0.8  # arms stay where they are
    np.testing.assert_allclose(vertices, posed, atol=1e-6)
    assert jnp.asarray(0.5).dtype == np.float32  # for this alone


def test_weights_off_the_surface_are_those_of_the_nearest(bundled_body, vertices, rng):
    points = vertices[rng.integers(0, len(vertices), 300)] + 0.01 * rng.normal(size=(300, 3))
    found = template_weights(bundled_body, vertices, points)
    _, nearest = cKDTree(vertices).query(points)
    close = np.abs(found - np.asarray(bundled_body.weights)[nearest]).max(1)
    assert np.median(close) < 0.02  # a vertex spacing away at most


def test_expression_moves_the_face_as_the_posed_body_does(bundled_body, vertices, rng):
    """Against blend shapes under skinning, with joints that stay."""
    still = replace(bundled_body, joint_expression_dirs=0 * bundled_body.joint_expression_dirs)
    expression = rng.normal(size=10)
    params = replace(canonical_params(still), expression=jnp.asarray(expression))
    moved = np.asarray(pose_body(still, params).vertices) - vertices
    moves = canonical_expression_dirs(bundled_body) @ expression
    np.testing.assert_allclose(moves, moved, atol=1e-6)
    grid = template_expression(bundled_body, vertices, 0.006, 10)
    assert grid is not None
    on_face = bundled_body.parts.rows("face")
    points = jnp.asarray(vertices[on_face], jnp.float32)
    nodes = grid.under(jnp.asarray(expression, jnp.float32))
    read = np.asarray(jax.vmap(lambda x: grid.read(nodes, x))(points))
    away = np.linalg.norm(read - moved[on_face], axis=1)
    assert np.linalg.norm(moved[on_face], axis=1).max() > 0.005
    assert np.median(away) < 2e-4
    assert np.quantile(away, 0.95) < 2e-3  # less than a cell away something else moves
    assert not np.asarray(grid.read(nodes, jnp.asarray(vertices[0] - 1.0, jnp.float32))).any()


def test_bodies_without_a_face_or_expression_move_nothing(bundled_body, vertices):
    assert template_expression(bundled_body, vertices, 0.01, 0) is None
    faceless = replace(
        bundled_body, parts=bundled_body.parts.with_labels(0 * bundled_body.part_labels)
    )
    assert template_expression(faceless, vertices, 0.01, 10) is None


def test_grids_around_the_body(bundled_body, vertices, rng):
    grids = body_part_grids(bundled_body, vertices, COARSE)
    assert grids.spacing.shape == (4,)
    assert bool(grids.covers(jnp.asarray(vertices, jnp.float32)).all())


def test_template_skinning_near_the_surface(bundled_body, vertices, skinning, rng):
    pick = rng.integers(0, len(vertices), 400)
    points = jnp.asarray(vertices[pick], jnp.float32)
    found = np.asarray(eqx.filter_jit(lambda f, x: jax.vmap(f)(x))(skinning, points))
    np.testing.assert_allclose(found.sum(1), 1.0, atol=1e-5)
    assert np.abs(found - np.asarray(bundled_body.weights)[pick]).max(1).mean() < 0.1
    assert bool(skinning.grids.covers(points).all())
    assert not bool(skinning.covers(jnp.array([0.0, 5.0, 0.0])))


def test_the_correction_learns_and_the_template_does_not(skinning, vertices):
    points = jnp.asarray(vertices[:40], jnp.float32)
    loss = eqx.filter_grad(lambda f: jnp.sum(jax.vmap(f)(points)[:, 15] ** 2))
    slope = eqx.filter_jit(loss)(skinning)
    assert not np.asarray(slope.template).any()
    assert np.isfinite(slope.correction).all()


@pytest.fixture(scope="module")
def geometry(bundled_body, vertices):
    joints = np.asarray(canonical_joints(bundled_body, jnp.zeros(0)), np.float64)
    hand = np.asarray(bundled_body.part_labels) == 2
    box = (vertices[hand].min(0) - 0.02, vertices[hand].max(0) + 0.02, 0.01)
    face = vertices[np.isin(bundled_body.part_labels, (1, 4))]
    expressive = ExpressionGrid(
        face.min(0) - 0.05, face.max(0) + 0.05, spacing=0.02, num_expression=10, features=3
    )
    return HashGeometry(
        bundled_body.tree, joints, expressive, vertices.min(0) - 0.1, vertices.max(0) + 0.1,
        spacing=(0.1, 0.05, 0.02, 0.01), trunk_spacing=0.02, detail=(box,), features=2,
        log2_size=10, width=16, condition_width=6, sharpness=50.0, key=jax.random.key(0),
    )  # fmt: skip


def levels_of(field):
    return jax.jit(jax.vmap(lambda x, condition: field(x, condition).level, in_axes=(0, None)))


def params_of(body, **poses):
    return BodyParams.create(body, **poses)


def test_the_start_is_the_same_in_every_pose(bundled_body, vertices, geometry, rng):
    points = jnp.asarray(vertices[::400], jnp.float32)
    run = levels_of(geometry)
    zero = run(points, geometry.condition(BodyParams.zeros(bundled_body)))
    params = BodyParams.create(
        bundled_body, pose=rng.normal(size=(55, 3)), expression=rng.normal(size=10)
    )
    np.testing.assert_array_equal(run(points, geometry.condition(params)), zero)


@pytest.fixture
def loud(geometry, rng):
    """The field once it has learned to listen."""
    return eqx.tree_at(
        lambda g: (g.pose_weights, g.expressive.table),
        geometry,
        tuple(
            jnp.asarray(rng.normal(size=w.shape), jnp.float32)
            for w in (geometry.pose_weights, geometry.expressive.table)
        ),
    )


@pytest.mark.parametrize("smile", [0.0, 1.0])
def test_a_condition_without_zeros_gives_the_same_logits(bundled_body, vertices, loud, rng, smile):
    pose = np.zeros((55, 3))
    pose[[4, 22, 30]] = rng.normal(size=(3, 3))
    expression = smile * rng.normal(size=10)
    full = loud.condition(BodyParams.create(bundled_body, pose=pose, expression=expression))
    kept = loud.without_zeros(full)
    assert len(kept.joints) == 3
    assert len(kept.expression) == 10 * smile
    points = jnp.asarray(vertices[::100], jnp.float32)
    run = levels_of(loud)
    np.testing.assert_allclose(run(points, kept), run(points, full), atol=1e-5)


def test_the_condition_is_local_and_blind_to_the_root(bundled_body, vertices, loud, rng):
    run = levels_of(loud)
    joints, names = np.asarray(loud.joints), bundled_body.tree
    # Between nodes of the finest level a joint need not be inside: it is only a place to ask.
    zero = run(loud.joints, loud.condition(BodyParams.zeros(bundled_body)))

    def change(params):
        return np.abs(run(loud.joints, loud.condition(params)) - zero)

    turned = change(params_of(bundled_body, global_orient=[0.3, 2.0, 0.1]))
    assert not turned.any()
    jaw = change(params_of(bundled_body, jaw_pose=[0.5, 0, 0]))
    assert jaw[names.index("jaw")] > 1e-4
    assert jaw[names.index("left_knee")] == 0
    assert jaw[names.index("left_index1")] == 0
    expression = change(params_of(bundled_body, expression=rng.normal(size=10)))
    assert expression[names.index("left_eye")] > 1e-4
    assert expression[names.index("left_foot")] == 0
    elbow = np.zeros((55, 3))
    elbow[names.index("left_elbow"), 1] = 1.0
    elbow = change(params_of(bundled_body, pose=elbow))
    reach = float(loud.reach[names.index("left_elbow")])
    away = np.linalg.norm(joints - joints[names.index("left_elbow")], axis=1)
    assert elbow[names.index("left_elbow")] > 1e-4
    assert elbow[away > 6 * reach].max() < 1e-6


def test_nothing_is_heard_beyond_what_frames_have_shown(bundled_body, loud, rng):
    """A knee that bent to one radian is heard as bent so far at two; toes that lay still, not."""
    names = bundled_body.tree
    knee, toes = names.index("left_knee"), names.index("left_foot")

    def condition(field, *, bend=0.0, curl=0.0, smile=0.0):
        pose = np.zeros((55, 3))
        pose[knee, 0], pose[toes, 0] = bend, curl
        expression = np.r_[smile, np.zeros(9)]
        return field.condition(params_of(bundled_body, pose=pose, expression=expression))

    shown = np.zeros((20, 55, 3))
    shown[:, knee, 0] = np.linspace(0.2, 1.0, 20)
    smiles = np.zeros((20, 10))
    smiles[:, 0] = np.linspace(0.5, 0.8, 20)
    frames = jax.vmap(lambda p, e: params_of(bundled_body, pose=p, expression=e))(shown, smiles)
    field = loud.within(frames)
    for seen in ({"bend": 0.0}, {"bend": 0.6, "smile": 0.3}, {"bend": 1.0, "smile": 0.8}):
        for a, b in zip(condition(field, **seen), condition(loud, **seen), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)
    beyond = condition(field, bend=2.0, curl=-0.6, smile=5.0)
    limit = condition(loud, bend=1.0, smile=0.8)
    np.testing.assert_allclose(beyond.joints, limit.joints, atol=1e-6)
    np.testing.assert_allclose(beyond.expression, limit.expression, atol=1e-6)
    assert beyond.moves[0] == 5.0, "what is not learned does not depend on the frames"
    assert np.abs(condition(loud, curl=-0.6).joints[toes]).max() > 0.1


def test_expressions_are_read_trilinearly_and_fade_out(rng):
    """Linear functions of the place are given exactly, away from the edge of the box."""
    low, high = np.array([-0.1, 0.2, 0.0]), np.array([0.1, 0.5, 0.22])
    grid = ExpressionGrid(low, high, spacing=0.02, num_expression=2, features=3)
    slope, middle = rng.normal(size=(3, 2, 3)), (low + high) / 2
    axes = [low[k] + 0.02 * np.arange(grid.shape[k]) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    table = jnp.asarray(np.einsum("nd,dek->nek", nodes - middle, slope), jnp.float32)
    loud = eqx.tree_at(lambda g: g.table, grid, table)
    inside = rng.uniform(low + 0.025, high - 0.025, (50, 3))
    found = jax.vmap(loud)(jnp.asarray(inside, jnp.float32))
    expected = np.einsum("nd,dek->nek", inside - middle, slope)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    expression = rng.normal(size=2)
    nodes = loud.under(jnp.asarray(expression, jnp.float32))
    heard = jax.vmap(lambda x: loud.read(nodes, x))(jnp.asarray(inside, jnp.float32))
    np.testing.assert_allclose(heard, np.einsum("nek,e->nk", expected, expression), atol=1e-5)
    halfway = jnp.asarray([low[0] + 0.01, *middle[1:]], jnp.float32)
    edge = np.einsum("d,dek->ek", np.asarray(halfway) - middle, slope)
    np.testing.assert_allclose(loud(halfway), 0.5 * edge, atol=1e-5)
    assert not np.asarray(loud(jnp.asarray(low - 0.001, jnp.float32))).any()
    assert not np.asarray(loud(jnp.asarray(high + np.array([0, 0.05, 0]), jnp.float32))).any()


def test_motions_may_have_fewer_expression_coefficients_or_more(bundled_body, geometry):
    for count in (3, 10):
        params = BodyParams.create(bundled_body, expression=np.ones(count))
        condition = geometry.condition(params)
        assert condition.expression.shape == (10,)
        assert float(condition.expression.sum()) == count


def test_fine_levels_are_heard_inside_their_boxes_alone(geometry):
    low, high = (np.asarray(b) for b in (geometry.detail_low[0], geometry.detail_high[0]))
    levels = geometry.encoding.spacing
    middle = geometry._level_mask(jnp.asarray((low + high) / 2, jnp.float32))
    np.testing.assert_allclose(middle, np.ones(len(levels)), atol=1e-6)
    outside = geometry._level_mask(jnp.asarray(high + 0.01, jnp.float32))
    np.testing.assert_array_equal(outside, [1, 1, 1, 0])
    border = geometry._level_mask(
        jnp.asarray([low[0] + 0.01, *((low + high) / 2)[1:]], jnp.float32)
    )
    np.testing.assert_allclose(border, [1, 1, 1, 0.5], atol=1e-4)


def test_geometry_gradients_reach_every_part(bundled_body, vertices, geometry, rng):
    params = BodyParams.create(
        bundled_body, pose=0.3 * rng.normal(size=(55, 3)), expression=rng.normal(size=10)
    )
    points = jnp.asarray(vertices[::400], jnp.float32)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(field):
        return jnp.sum(levels_of(field)(points, field.condition(params)) ** 2)

    gradient = slope(geometry)
    for part in (gradient.encoding.table, gradient.pose_weights, gradient.expressive.table):
        assert np.isfinite(part).all()
        assert np.abs(part).max() > 0
