"""Geometry fields at fixed points against the fields themselves."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.body import FACES, canonical_vertices
from xavatar_jax.fields import MLPShape, grid_vertices, template_expression
from xavatar_jax.training import fresh_fields


def random_geometry(body, kind: str):
    """A field in which everything speaks: condition, fine levels, all layers."""
    config = xa.quick()
    shape = MLPShape(width=32, depth=3, skip=())
    config = replace(config, geometry=replace(config.geometry, kind=kind, mlp=shape))
    config = replace(config, skinning=replace(config.skinning, kind="mlp"))
    geometry = fresh_fields(body, config).geometry
    arrays, rest = eqx.partition(geometry, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    keys = jax.random.split(jax.random.key(4), len(leaves))
    leaves = [x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    loud = eqx.combine(jax.tree.unflatten(structure, leaves), rest)
    if kind == "hash":
        loud = eqx.tree_at(lambda g: g.fixed_leaves, loud, geometry.fixed_leaves)
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
        expected = jax.vmap(lambda x, c=condition: geometry(x, c))(points)
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
    on_face = np.isin(np.asarray(bundled_body.part_labels), FACES)
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
    expected = jax.vmap(lambda x: still(x, condition))(points)
    np.testing.assert_allclose(fixed(condition), expected, atol=1e-5 * np.abs(expected).max())
    # The field itself finds the place back by substitution.
    back = jax.vmap(lambda x: geometry.carried_from(x, condition))(carried)
    away = np.linalg.norm(back - points, axis=1)
    assert np.quantile(away, 0.99) < 2e-4
    assert np.quantile(away, 0.5) < 1e-5
