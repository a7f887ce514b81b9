"""Geometry fields at fixed points against the fields themselves."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.body import canonical_vertices
from xavatar_jax.fields import MLPShape
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
        loud = eqx.tree_at(lambda g: g.told, loud, geometry.told)
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
