"""Roles, links, and operations on whole models."""

from __future__ import annotations

import json
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import xavatar_jax as xa
from xavatar_jax.fields import (
    AbstractPlainGeometry,
    GeometrySpec,
    GeometryValue,
    GridSpacing,
    LinkSpec,
    ModelSpec,
    Occupancy,
    SignedDistance,
    SkinningSpec,
    build_link,
    build_model,
    check_model,
    fixed,
    grid_vertices,
    lay_on_person,
    learned,
    learned_leaves,
    mean_shape_model,
    stack_models,
    stored,
    stored_leaves,
)

COARSE = GridSpacing(body=0.08, hands=0.03, face=0.04)
SPEC = ModelSpec(
    SkinningSpec(grid=COARSE, correction=COARSE),
    GeometrySpec(
        spacing=(0.1, 0.05, 0.02), trunk=0.05, hands=0.02, face=0.02, log2_size=10, width=8,
        condition=4, expression_spacing=0.04, expression_moves=0.03,
    ),
)  # fmt: skip


class Inner(eqx.Module):
    weight: jax.Array
    index: jax.Array
    layout: jax.Array = stored()
    cache: jax.Array = fixed()


class Outer(eqx.Module):
    plain: Inner
    kept: Inner = stored()
    rebuilt: Inner = fixed()
    tuned: tuple[Inner, jax.Array] = learned()
    size: int = eqx.field(static=True, default=3)


def test_roles_of_nested_modules():
    """The most restrictive role on the way to a leaf holds."""
    inner = Inner(jnp.zeros(2), jnp.arange(2), jnp.zeros(1), jnp.zeros(1))
    outer = Outer(inner, inner, inner, (inner, jnp.zeros(2)))
    found = {
        jax.tree_util.keystr(path): kept + changed
        for (path, kept), changed in zip(
            jax.tree_util.tree_leaves_with_path(stored_leaves(outer)),
            jax.tree.leaves(learned_leaves(outer)),
            strict=True,
        )
    }
    nested = {"weight": 2, "index": 0, "layout": 1, "cache": 0}
    expected = {f".plain.{k}": v for k, v in nested.items()}
    expected |= {f".kept.{k}": min(v, 1) for k, v in nested.items()} | {".kept.index": 1}
    expected |= {f".rebuilt.{k}": 0 for k in nested}
    expected |= {f".tuned[0].{k}": v for k, v in nested.items()} | {".tuned[0].index": 1}
    assert found == expected | {".tuned[1]": 2}


@pytest.fixture(scope="module")
def people(toy_body):
    """Two people's models, and their shapes."""
    betas = [np.r_[1.0, -1, np.zeros(8)], np.r_[-1.5, 0.5, 1, np.zeros(7)]]
    return [build_model(SPEC, toy_body, key=jax.random.key(0), betas=b) for b in betas], betas


def paths(mask):
    leaves = jax.tree_util.tree_leaves_with_path(mask)
    return {jax.tree_util.keystr(path).lstrip(".") for path, on in leaves if on}


def test_roles_of_a_model(people):
    model = people[0][0]
    tuned, kept = paths(learned_leaves(model)), paths(stored_leaves(model))
    network = {f"geometry.{part}[{k}]" for part in ("hidden", "biases") for k in range(3)}
    features = {f"geometry.{k}" for k in ("encoding.table", "expressive.table", "pose_weights")}
    assert tuned == {"skinning.correction"} | network | features
    assert tuned < kept
    assert {f"geometry.encoding.{k}" for k in ("origin", "shapes", "offsets")} < kept
    assert {"geometry.joints", "geometry.reach", "geometry.pose_range"} < kept
    assert {"skinning.correction_grids.index", "skinning.correction_grids.nodes"} < kept
    assert not any(name.startswith(("skinning.template", "skinning.grids.")) for name in kept)
    assert not any(name.startswith("geometry.moves") for name in kept)


def test_models_of_two_people_in_one_program(people, toy_body, rng):
    """Vmapped over stacked models: what each model gives alone, compiled once."""
    models, betas = people
    traces = []

    @eqx.filter_jit
    def run(stack, points, params):
        traces.append(0)

        def one(model, points):
            condition = model.geometry.condition(params)
            levels = jax.vmap(lambda x: model.geometry(x, condition).level)(points)
            return levels, jax.vmap(model.skinning)(points), jax.vmap(model.skinning.covers)(points)

        return eqx.filter_vmap(one)(stack, points)

    models = [replace(m, geometry=randomize(m.geometry)) for m in models]
    params = xa.BodyParams.create(
        toy_body, pose=0.3 * rng.normal(size=(55, 3)), expression=rng.normal(size=10)
    )
    points = [grid_vertices(toy_body, b)[::40] + 0.01 for b in betas]
    points = jnp.asarray(np.stack(points), jnp.float32)
    found = run(stack_models(models), points, params)
    swapped = run(stack_models(models[::-1]), points[::-1], params)
    assert len(traces) == 1
    assert np.abs(found[0][0] - found[0][1]).max() > 1e-3
    for k, model in enumerate(models):
        alone = run(jax.tree.map(lambda x: x[None], model), points[k : k + 1], params)
        for a, b, c in zip(found, swapped, alone, strict=True):
            np.testing.assert_allclose(a[k], c[0], atol=1e-5)
            np.testing.assert_allclose(b[1 - k], c[0], atol=1e-5)


def randomize(geometry):
    """A field whose learned arrays all matter."""
    tuned, rest = eqx.partition(geometry, learned_leaves(geometry))
    leaves, structure = jax.tree.flatten(tuned)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    leaves = [x + 0.1 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return eqx.combine(jax.tree.unflatten(structure, leaves), rest)


def test_a_model_laid_on_a_person_is_the_one_built_for_it(people, toy_body):
    models, betas = people
    mean = mean_shape_model(SPEC, toy_body, key=jax.random.key(0), betas=betas[0])
    laid = lay_on_person(mean, SPEC, toy_body, betas[0], key=jax.random.key(0))
    assert eqx.tree_equal(laid, models[0])
    table = mean.geometry.encoding.table + 1
    fitted = eqx.tree_at(lambda m: m.geometry.encoding.table, mean, table)
    laid = lay_on_person(fitted, SPEC, toy_body, betas[0], key=jax.random.key(0))
    np.testing.assert_array_equal(laid.geometry.encoding.table, table)


def test_specs_survive_json():
    spec = replace(SPEC, link=LinkSpec("signed_distance", 0.01))
    assert ModelSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec
    with pytest.raises(ValueError, match=r"spec\.geometry: unknown entry 'colour'"):
        ModelSpec.from_dict({"geometry": {"colour": 1}})
    assert build_link(spec.link) == SignedDistance(0.01)


WRONG = {
    "geometry.encoding.table": (lambda m: m.geometry.encoding.table[:-1], "expected"),
    "geometry.encoding.offsets": (lambda m: m.geometry.encoding.offsets.at[1].add(1), "do not fit"),
    "geometry.expressive.table": (lambda m: m.geometry.expressive.table[:, :-1], "expected"),
    "geometry.hidden[1]": (lambda m: m.geometry.hidden[1][:, :-1], r"\(8, 7\), expected \(8, 8\)"),
    "geometry.pose_weights": (lambda m: m.geometry.pose_weights[:-1], "expected"),
    "geometry.pose_range": (lambda m: m.geometry.pose_range.at[0, 3, 2].set(jnp.nan), "nan"),
    "geometry.joints": (lambda m: m.geometry.joints.at[3, 2].set(jnp.inf), r"inf at \(3, 2\)"),
    "skinning.correction": (lambda m: m.skinning.correction[:-1], "expected"),
    "skinning.correction_grids.index": (
        lambda m: m.skinning.correction_grids.index.at[5].set(10**6), "values",
    ),
    "skinning.correction_grids.nodes": (lambda m: m.skinning.correction_grids.nodes[1:], ""),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_leaves_are_named(people, name):
    """As a damaged file would give them: put in the place of those that were built."""
    model = people[0][0]
    check_model(model)
    wrong, message = WRONG[name]
    path = {"nodes": "skinning.correction"}.get(name.rsplit(".")[-1], name)
    leaves, structure = jax.tree_util.tree_flatten_with_path(model)
    damaged = [
        wrong(model) if jax.tree_util.keystr(key).lstrip(".") == name else leaf
        for key, leaf in leaves
    ]
    # Equinox modules are not made anew here: their own checks do not run.
    model = jax.tree.unflatten(structure, damaged)
    with pytest.raises(ValueError, match=rf"^{path}.*{message}".replace("[", r"\[", 1)):
        check_model(model)


LINKS = {
    "soft": Occupancy(0.004), "hard": Occupancy(0.0), "distance": SignedDistance(0.01)
}  # fmt: skip


@pytest.mark.parametrize("name", LINKS)
def test_links(x64, name):
    """Losses against their formulas in NumPy, and their slopes against differences."""
    link = LINKS[name]
    level, distance = np.array([-3.0, -0.2, 0.3, 2.5]), np.array([-0.01, 0.002, -0.003, 0.02])
    p = 1 / (1 + np.exp(-level))
    if name == "distance":
        expected, inside = np.abs(level - distance), np.maximum(-level, 0)
        p = 1 / (1 + np.exp(-level / 0.01))
        best = distance
    else:
        inside = -np.log(p)
        q = (distance > 0).astype(float) if name == "hard" else 1 / (1 + np.exp(-distance / 0.004))
        best = 1e3 * distance / (1 if name == "soft" else 1e-3) / (4 if name == "soft" else 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            entropy = np.nan_to_num(-q * np.log(q)) + np.nan_to_num(-(1 - q) * np.log(1 - q))
        expected = -q * np.log(p) - (1 - q) * np.log(1 - p) - entropy
    level, distance = jnp.asarray(level), jnp.asarray(distance)
    np.testing.assert_allclose(link.loss(level, distance), expected, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(link.loss(jnp.asarray(best), distance), 0, atol=1e-3)
    np.testing.assert_allclose(link.inside_loss(level), inside, rtol=1e-10)
    np.testing.assert_allclose(link.probability(level), p, rtol=1e-10)
    assert float(link.probability(jnp.asarray(link.outside))) < 1e-4
    total = lambda v: jnp.sum(link.loss(v, distance) + link.inside_loss(v) + link.probability(v))  # noqa: E731
    np.testing.assert_allclose(
        jax.grad(total)(level),
        central_difference(lambda v: total(jnp.asarray(v)), level),
        rtol=1e-6,
    )


def test_distances_of_a_link_are_those_to_a_plane(x64, rng):
    normal, height = rng.normal(size=3), 0.4
    points = rng.normal(size=(20, 3))
    level, slope = jax.vmap(jax.value_and_grad(lambda x: jnp.sum(normal * x) - height))(points)
    expected = (points @ normal - height) / np.linalg.norm(normal)
    np.testing.assert_allclose(Occupancy().distance(level, slope), expected, rtol=1e-9)


def test_plain_fields_need_two_methods(toy_body):
    class Ball(AbstractPlainGeometry):
        def condition(self, params):
            return params.expression[0]

        def __call__(self, x_c, condition):
            return GeometryValue(0.5 + condition - jnp.sqrt(jnp.sum(x_c**2)))

    ball = Ball()
    points = jnp.asarray([[0.1, 0.0, 0.0], [0.7, 0.0, 0.0]])
    cache = ball.at(points)
    np.testing.assert_allclose(cache(jnp.asarray(0.1)), [0.5, -0.1], atol=1e-6)
    np.testing.assert_array_equal(cache.carried(jnp.asarray(0.1)), points)
