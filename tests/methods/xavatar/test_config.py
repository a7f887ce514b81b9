"""Options and presets: round trips, the published numbers, ablations."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

import xavatar_jax as xa
from xavatar_jax.fields import MLPShape
from xavatar_jax.methods.xavatar.config import ABLATIONS, PRESETS


def leaves(values, path=()):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name), value


def test_the_defaults_are_the_preset_quick():
    assert xa.FitConfig() == xa.quick() == PRESETS["quick"]()
    assert xa.FitConfig().preset == "quick"


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_config_survives_json(preset):
    config = PRESETS[preset]()
    assert xa.FitConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_a_config_of_an_older_file_gets_defaults_for_what_it_lacks():
    values = xa.quick().to_dict()
    for name in ("validation", "checkpoint_every", "report_every", "frames_per_minute"):
        del values[name]
    assert xa.FitConfig.from_dict(values) == xa.quick()


def test_an_entry_that_is_not_known_is_named():
    values = xa.quick().to_dict()
    values["losses"]["weather"] = 1.0
    with pytest.raises(ValueError, match="weather"):
        xa.FitConfig.from_dict(values)


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("A1", {("search", "starts"): "body"}),
        ("A2", {("search", "starts"): "all_bones"}),
        ("A3", {("points", "uniform"): True}),
        ("A4", {("losses", "surface"): 0.0, ("skinning", "around"): "mean"}),
    ],
)
def test_an_ablation_changes_one_thing(preset, name, changed):
    config = PRESETS[preset]()
    before = dict(leaves(config.to_dict()))
    after = dict(leaves(ABLATIONS[name](config).to_dict()))
    assert {k: after[k] for k in after if after[k] != before[k]} == changed
    assert sorted(ABLATIONS) == ["A1", "A2", "A3", "A4"]


def test_cached_roots_of_a_random_field_are_refused():
    config = xa.quick()
    with pytest.raises(ValueError, match=r"skinning\.start='random' needs search\.cached=False"):
        replace(config, skinning=replace(config.skinning, start="random"))


def test_the_published_numbers():
    """Counts, weights and schedule of the SMPL-X configuration for GRAB."""
    config = xa.paper()
    plan, losses, search = config.points, config.losses, config.search
    assert (config.steps, config.frames_per_step, config.points_per_step) == (45_000, 4, 6000)
    assert (plan.body, plan.face, plan.eyes_mouth, plan.hand) == (2000, 1000, 1000, 1000)
    assert (plan.box, plan.sigma, plan.fine_sigma, plan.by_vertex) == (0, (0.01,), (0.01,), True)
    assert (losses.softness, losses.bone, losses.joint, losses.surface) == (0, 1, 10, 10)
    assert (losses.surface_parts, losses.surface_points) == ("hands_face", 0)
    assert (search.atol, search.max_steps, search.cached) == (1e-5, 50, False)
    assert (config.optimiser.schedule, config.optimiser.clip) == ("constant", 0.1)
    assert config.optimiser.warmup == 1000  # ours: docs/options.md says why
    assert config.optimiser.learning_rate == config.optimiser.skinning_rate == 1e-3
    assert config.skinning.mlp == replace(MLPShape(), width=128, depth=5, octaves=0, skip=(),
                                          condition_at=())  # fmt: skip
    assert config.geometry.mlp == MLPShape(512, 8, 4, (4,), (0,), 16)
