"""Ablations change one thing each; fields that start at random know nothing of the template."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from xavatar_jax.training import (
    ABLATIONS,
    PRESETS,
    config_to_dict,
    fresh_fields,
    initial_fields,
    prefit,
    settle_on_person,
)

import xavatar_jax as xa
from xavatar_jax.body import canonical_vertices
from xavatar_jax.fields import MLPShape, hierarchical_softmax, num_logits
from xavatar_jax.frames import frames_from_params
from xavatar_jax.geometry import face_areas
from xavatar_jax.sampling import SamplingPlan, volume_points


def leaves(values, path=()):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name), value


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize(
    ("name", "entry", "value"),
    [
        ("A1", ("search", "starts"), "body"),
        ("A2", ("search", "starts"), "all_bones"),
        ("A3", ("points", "uniform"), True),
        ("A4", ("losses", "surface"), 0.0),
    ],
)
def test_an_ablation_changes_one_entry(preset, name, entry, value):
    config = PRESETS[preset]()
    before = dict(leaves(config_to_dict(config)))
    after = dict(leaves(config_to_dict(ABLATIONS[name](config))))
    assert {k for k in after if after[k] != before[k]} == {entry}
    assert after[entry] == value
    assert sorted(ABLATIONS) == ["A1", "A2", "A3", "A4"]


def test_uniform_sampling_is_by_area_and_keeps_parts_and_noise():
    body = xa.synthetic_body()
    frame = frames_from_params(body, xa.BodyParams.zeros(body, (1,)))[0]
    labels = np.asarray(body.part_labels)
    plan = replace(
        SamplingPlan(sigma=(0.01,), fine_sigma=(0.0,), by_vertex=False, uniform=True),
        body=2000, face=400, eyes_mouth=0, hand=300, box=100,
    )  # fmt: skip
    drawn = volume_points(frame, body.parts.with_labels(labels), plan, np.random.default_rng(0))
    assert len(drawn.x_d) == plan.total
    faces = np.asarray(frame.faces)
    areas = face_areas(np.asarray(frame.vertices, float), faces)
    surface = slice(0, plan.total - plan.box)
    for parts in ((0,), (2, 3)):
        share = areas[np.isin(labels[faces[:, 0]], parts)].sum() / areas.sum()
        found = np.isin(drawn.part[surface], parts).mean()
        # Three standard deviations of a share of three thousand draws.
        assert abs(found - share) < 3 * np.sqrt(share * (1 - share) / 3000)
    hands = np.isin(drawn.part[surface], (2, 3))
    # Points of the hands have the noise of the hands, which is none here.
    assert np.abs(drawn.distance[surface][hands]).max() < 1e-6
    assert np.median(np.abs(drawn.distance[surface][drawn.part[surface] == 0])) > 0.003


@pytest.mark.parametrize("kind", ["grid", "mlp"])
def test_a_random_start_has_nothing_of_the_template(kind, case, tmp_path, monkeypatch):
    """The fit to the mean shape leaves the weights as drawn; settling takes steps of its own."""
    monkeypatch.setattr(prefit, "_POINTS", 2000)
    body, _, config, _, _ = case
    skinning = replace(
        config.skinning, kind=kind, start="random",
        mlp=MLPShape(width=32, depth=2, octaves=0, skip=(), condition_at=()),
    )  # fmt: skip
    config = replace(config, skinning=skinning, prefit_steps=2, settle_steps=0)
    drawn = fresh_fields(body, config)
    fitted = initial_fields(body, config, cache=tmp_path, verbose=False)
    settled = settle_on_person(body, fitted, np.zeros(10), config)
    points = np.asarray(canonical_vertices(body, np.zeros(10)), np.float32)[::100]
    found = [np.asarray(jax.vmap(f.skinning)(points)) for f in (drawn, fitted, settled)]
    assert np.array_equal(found[0], found[1])
    np.testing.assert_allclose(found[1], found[2], atol=1e-5)
    assert not np.array_equal(drawn.geometry.biases[0], fitted.geometry.biases[0])
    if kind == "grid":
        # No logit has a mean: what a softmax of zeros gives, and a little to either side.
        even = hierarchical_softmax(body.tree, np.zeros(num_logits(body.tree), np.float32))
        assert 1e-3 < np.abs(found[0] - even).max() < 0.1
        assert not np.any(drawn.skinning.template)


def test_without_the_surface_term_nothing_lays_the_weights_on_the_person(case):
    body, _, config, fields, _ = case
    betas = np.full(10, 2.0)
    off = ABLATIONS["A4"](config)
    same = settle_on_person(body, fields, betas, off).skinning
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(fields.skinning), strict=True):
        assert np.array_equal(a, b)
    moved = settle_on_person(body, fields, betas, config).skinning
    assert not eqx.tree_equal(moved, fields.skinning)


@pytest.fixture(scope="module")
def network(case):
    """A network as drawn, a person, and the config for it."""
    body, _, config, _, _ = case
    skinning = replace(
        config.skinning, kind="mlp", start="random",
        mlp=MLPShape(width=32, depth=2, octaves=3, skip=(), condition_at=()),
    )  # fmt: skip
    config = replace(config, skinning=skinning, settle_steps=60)
    return body, fresh_fields(body, config), np.full(10, 1.5), config


def weight_error(body, fields, betas):
    """Mean over vertices of what differs from the body's weights, all bones together."""
    found = jax.jit(jax.vmap(fields.skinning))(canonical_vertices(body, betas))
    return np.abs(np.asarray(found) - np.asarray(body.weights)).sum(1).mean()


def test_a_network_is_settled_on_the_person(network):
    body, fields, betas, config = network
    settled = settle_on_person(body, fields, betas, config)
    assert weight_error(body, settled, betas) < 0.7 * weight_error(body, fields, betas)
    # As drawn, nearly all of a vertex's weight is with bones that it should not be with.
    assert weight_error(body, fields, betas) > 1.5
    # Geometry has no part in it: but for its joints, which are the person's from the start.
    assert eqx.tree_equal(settled.geometry.biases, fields.geometry.biases)
    assert eqx.tree_equal(settle_on_person(body, fields, betas, config), settled)


def test_settling_has_no_surface_in_the_ablation_without_it(network):
    """A4: joints alone teach the weights, so that the surface learns less."""
    body, fields, betas, config = network
    settled = settle_on_person(body, fields, betas, config)
    alone = settle_on_person(body, fields, betas, ABLATIONS["A4"](config))
    assert not eqx.tree_equal(alone.skinning, fields.skinning)
    assert weight_error(body, alone, betas) > 1.1 * weight_error(body, settled, betas)


@pytest.mark.parametrize("change", [{"settle_steps": 0}, {"learned": False}])
def test_weights_that_are_kept_do_not_settle(change, network):
    body, fields, betas, config = network
    if "learned" in change:
        config = replace(config, skinning=replace(config.skinning, **change))
    else:
        config = replace(config, **change)
    kept = settle_on_person(body, fields, betas, config)
    assert eqx.tree_equal(kept.skinning, fields.skinning)


def test_stored_roots_of_a_random_field_are_refused(case):
    body, frames, config, _, _ = case
    config = replace(config, skinning=replace(config.skinning, start="random"))
    with pytest.raises(ValueError, match=r"skinning\.start='random' with search\.cached=True"):
        xa.fit(frames, config, body=body, verbose=False)
