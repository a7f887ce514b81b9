"""Caches of a geometry field against the field itself, and the inverse of `carry`."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.body import canonical_vertices
from xavatar_jax.fields import (
    MOST_EXPRESSION,
    GeometrySpec,
    MLPShape,
    ModelSpec,
    SkinningSpec,
    build_model,
    grid_vertices,
    learned_leaves,
    template_expression,
)


def random_geometry(body, kind: str):
    """A field in which everything speaks: condition, fine levels, all layers."""
    shape = MLPShape(width=32, depth=3, skip=())
    spec = ModelSpec(SkinningSpec(kind="mlp"), GeometrySpec(kind=kind, mlp=shape))
    geometry = build_model(spec, body, key=jax.random.key(0)).geometry
    arrays, rest = eqx.partition(geometry, learned_leaves(geometry))
    leaves, structure = jax.tree.flatten(arrays)
    keys = jax.random.split(jax.random.key(4), len(leaves))
    leaves = [x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    loud = eqx.combine(jax.tree.unflatten(structure, leaves), rest)
    return loud


@pytest.mark.parametrize("kind", ["hash", "mlp"])
def test_fixed_points_give_the_field(bundled_body, kind, rng):
    geometry = random_geometry(bundled_body, kind)
    vertices = np.asarray(canonical_vertices(bundled_body, jnp.zeros(10)))
    points = jnp.asarray(vertices[::60] + 0.01 * rng.normal(size=vertices[::60].shape), jnp.float32)
    fixed = geometry.at(points)
    seen = []
    for scale in (0.0, 0.5, 1.0):
        params = xa.BodyParams.create(
            bundled_body,
            pose=scale * rng.normal(size=(55, 3)),
            expression=scale * rng.normal(size=10),
        )
        condition = geometry.condition(params)
        expected = jax.vmap(lambda x, c=condition: geometry(x, c).level)(points)
        seen.append(np.asarray(expected))
        tolerance = 1e-5 * float(jnp.abs(expected).max())
        np.testing.assert_allclose(fixed(condition), expected, atol=tolerance)
    assert np.abs(seen[2] - seen[0]).max() > 0.01


def test_fixed_points_follow_the_expression(bundled_body, rng):
    """Where they are carried, the field is what it would be in place if nothing moved."""
    still = random_geometry(bundled_body, "hash")
    vertices = grid_vertices(bundled_body)
    moves = template_expression(bundled_body, vertices, 0.01, 10)
    assert moves is not None
    geometry = eqx.tree_at(lambda g: g.moves, still, moves, is_leaf=lambda x: x is None)
    on_face = bundled_body.parts.mask("face")
    points = jnp.asarray(vertices[on_face][::20], jnp.float32)
    params = xa.BodyParams.create(
        bundled_body, pose=0.5 * rng.normal(size=(55, 3)), expression=0.5 * rng.normal(size=10)
    )
    condition = geometry.condition(params)
    fixed = geometry.at(points)
    carried = fixed.carried(condition)
    each = jax.vmap(lambda x: geometry.carry(x, condition))
    np.testing.assert_allclose(carried, each(points), atol=1e-6)
    assert np.abs(carried - points).max() > 0.002
    expected = jax.vmap(lambda x: still(x, condition).level)(points)
    np.testing.assert_allclose(fixed(condition), expected, atol=1e-5 * np.abs(expected).max())
    # The field itself finds the place back by substitution.
    back, _ = jax.vmap(lambda x: geometry.carried_from(x, condition))(carried)
    away = np.linalg.norm(back - points, axis=1)
    assert np.quantile(away, 0.99) < 2e-4
    assert np.quantile(away, 0.5) < 1e-5


@pytest.fixture(scope="module")
def moving(bundled_body):
    """A field that follows the body's expression, and points of its face."""
    vertices = grid_vertices(bundled_body)
    geometry = random_geometry(bundled_body, "hash")
    moves = template_expression(bundled_body, vertices, 0.008, 10)
    geometry = eqx.tree_at(lambda g: g.moves, geometry, moves, is_leaf=lambda x: x is None)
    on_face = bundled_body.parts.mask("face")
    return geometry, jnp.asarray(vertices[on_face][::4], jnp.float32)


@pytest.mark.parametrize(("sigmas", "share"), [(1.0, 1.0), (2.0, 0.995), (3.0, 0.97), (10.0, 0.8)])
def test_the_inverse_of_carry_says_how_close_it_is(bundled_body, moving, rng, sigmas, share):
    """Far outside the usual range too: what is returned is where `carry` leads, or says so."""
    geometry, points = moving
    params = xa.BodyParams.create(bundled_body, expression=sigmas * rng.normal(size=10))
    condition = geometry.condition(params)
    assert np.abs(condition.moves).max() <= MOST_EXPRESSION
    carry = jax.jit(jax.vmap(lambda x: geometry.carry(x, condition)))
    target = carry(points)
    found, missing = jax.jit(jax.vmap(lambda x: geometry.carried_from(x, condition)))(target)
    away = np.linalg.norm(carry(found) - target, axis=1)
    np.testing.assert_allclose(missing, away, atol=1e-6)
    assert (away < 2e-5).mean() >= share
    assert away.max() <= np.linalg.norm(carry(target) - target, axis=1).max()


def test_the_derivative_of_the_inverse_is_exact(x64, bundled_body, moving, rng):
    """Against the inverse of the derivative of `carry`, and differences in the expression."""
    geometry, points = jax.tree.map(
        lambda x: x.astype(jnp.float64) if eqx.is_inexact_array(x) else x, moving
    )
    condition = geometry.condition(xa.BodyParams.create(bundled_body, expression=np.ones(10)))
    moves = jnp.asarray(0.7 * rng.normal(size=10))
    inverse = lambda x, m: geometry.carried_from(x, condition._replace(moves=m))[0]  # noqa: E731
    carry = lambda x: geometry.carry(x, condition._replace(moves=moves))  # noqa: E731
    for x in points[::150]:
        target = carry(x)
        back = inverse(target, moves)
        expected = np.linalg.inv(jax.jacfwd(carry)(back))
        for jacobian in (jax.jacfwd, jax.jacrev):
            np.testing.assert_allclose(jacobian(inverse)(target, moves), expected, atol=1e-5)
        slope = jax.jacrev(inverse, 1)(target, moves)
        step = 1e-3 * rng.normal(size=10)
        change = inverse(target, moves + step) - inverse(target, moves - step)
        np.testing.assert_allclose(slope @ step, change / 2, atol=3e-6)
