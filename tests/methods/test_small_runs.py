"""Small runs of both baselines: the loss falls, and the surface is closed."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.avatar import body_only_params
from xavatar_jax.fields import GridSpacing
from xavatar_jax.frames import frames_from_params
from xavatar_jax.methods import (
    fit_scanimate,
    fit_snarf,
    scanimate_paper,
    scanimate_quick,
    snarf_paper,
    snarf_quick,
)
from xavatar_jax.methods.scanimate.networks import LocalPoseMLP
from xavatar_jax.methods.xavatar import start as mean_shape

COARSE = GridSpacing(body=0.05, hands=0.02, face=0.03, band=0.06)


@pytest.fixture(scope="module")
def start():
    """SNARF's config with coarse fields, few points and few steps."""
    config = snarf_quick()
    return replace(
        config,
        steps=40,
        train_frames=2,
        frames_per_step=2,
        points_per_step=256,
        prefit_steps=30,
        report_every=5,
        points=replace(config.points, body=500, face=0, eyes_mouth=0, hand=0, box=50),
        skinning=replace(config.skinning, grid=COARSE, correction=COARSE),
        geometry=replace(config.geometry, spacing=(0.12, 0.06, 0.03), log2_size=14, width=32),
    )


@pytest.fixture(scope="module")
def frames(toy_body):
    rng = np.random.default_rng(5)
    pose = np.deg2rad(10) * rng.standard_normal((2, toy_body.num_joints, 3))
    # A person of another shape than the mean: there is something to learn.
    params = xa.BodyParams.create(toy_body, pose=pose, betas=1.5 * np.ones(10))
    return frames_from_params(toy_body, params)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """The fit to the mean shape looks at fewer points, and is made once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mean_shape, "_POINTS", 20_000)
        yield tmp_path_factory.mktemp("start")


def check_closed(mesh: xa.Mesh) -> None:
    """Every edge has two triangles, which run along it in opposite directions."""
    edges = np.concatenate([mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    there = {(int(a), int(b)) for a, b in edges}
    assert len(there) == len(edges)
    assert {(b, a) for a, b in there} == there
    assert mesh.volume > 0  # a few steps on coarse grids leave a rough surface


def check_fell(values: list[float]) -> None:
    heard = [v for v in values if np.isfinite(v)]
    assert np.mean(heard[-2:]) < 0.9 * heard[0]


def test_snarf_learns(start, frames, cache):
    config = replace(start, steps=120)
    found = fit_snarf(frames, config, cache=cache, verbose=False)
    check_fell(found.history.terms["occupancy"])
    assert found.avatar.avatar.options == config.to_dict()
    assert found.avatar.avatar.method == "snarf"


def test_scanimate_learns(start, frames, cache):
    config = scanimate_quick()
    config = replace(
        config,
        train_frames=2,
        triangles=300,
        start=start,
        skin=replace(config.skin, steps=0),
        cycle=replace(config.cycle, steps=30, frames=2, points=32),
        shape=replace(config.shape, steps=300, frames=2, points=200),
    )
    found = fit_scanimate(frames, config, cache=cache, verbose=False)
    terms, history = found.history.terms, found.history
    check_fell(terms["shape_surface"])
    assert history.steps_done == 330
    assert history.stopped == "steps"
    assert {"prefit", "data", "train", "canonical", "total"} <= set(history.seconds)
    avatar = found.avatar.avatar
    own = body_only_params(avatar.body, frames.params[0])
    check_closed(avatar.mesh(own, cell=0.03))


def test_scanimates_own_networks_learn(start, frames, cache):
    """Stages 1 to 3 with networks in place of grids, and losses on derivatives."""
    config = scanimate_paper()
    assert config.forward is not None
    assert config.distance is not None
    networks = replace(
        config.start,
        prefit_steps=40,
        geometry=replace(config.start.geometry, kind="mlp"),
        search=replace(config.start.search, grid=COARSE),
        optimiser=start.optimiser,
    )
    config = replace(
        config,
        train_frames=2,
        triangles=200,
        start=networks,
        forward=replace(config.forward, width=32),
        inverse=replace(config.inverse, width=32),
        distance=replace(config.distance, width=40, depth=2, skip=()),
        skin=replace(config.skin, steps=60, frames=2, points=32),
        cycle=replace(config.cycle, steps=4, frames=2, points=32, rate=1e-3),
        shape=replace(config.shape, steps=4, frames=2, points=64),
    )
    found = fit_scanimate(frames, config, cache=cache, verbose=False)
    terms = found.history.terms
    check_fell(terms["skin_loss"])
    assert {"skin_scan", "cycle_cycle", "shape_normal", "shape_eikonal"} <= set(terms)
    assert "shape_offset" not in terms
    fields = found.avatar.avatar.model
    assert isinstance(fields.geometry, LocalPoseMLP)
    assert eqx.tree_equal(fields.geometry.skinning, fields.skinning)


def test_paper_settings_are_the_published_sizes():
    config = snarf_paper()
    assert (config.geometry.mlp.width, config.geometry.mlp.depth) == (256, 8)
    assert (config.skinning.mlp.width, config.skinning.mlp.depth) == (128, 4)
    assert config.points.total == config.points_per_step == 2250
    config = scanimate_paper()
    assert config.forward is not None
    assert config.distance is not None
    assert (config.forward.width, config.forward.depth) == (256, 3)
    assert (config.inverse.width, config.latent) == (256, 64)
    assert (config.distance.width, config.distance.depth) == (512, 6)
    for settings in (config, scanimate_quick()):
        stages = (settings.skin, settings.cycle, settings.shape)
        np.testing.assert_allclose(sum(stage.share for stage in stages), 1)


@pytest.mark.parametrize("minutes", [0, -1.0, float("nan")])
def test_budgets_are_positive(frames, minutes):
    with pytest.raises(ValueError, match="minutes must be a positive number"):
        fit_snarf(frames, replace(snarf_quick(), minutes=minutes))
    with pytest.raises(ValueError, match="minutes must be a positive number"):
        fit_scanimate(frames, replace(scanimate_quick(), minutes=minutes))
