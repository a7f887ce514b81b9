"""The model at step 0: fitted to the mean shape, cached, and laid on the person."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from small_runs import fresh_model, same, tiny

import xavatar_jax as xa
from xavatar_jax.body import canonical_vertices, load_body
from xavatar_jax.files import load_arrays, save_arrays
from xavatar_jax.learning import TrainingNotice
from xavatar_jax.methods.xavatar import start
from xavatar_jax.methods.xavatar.start import fit_mean_shape, fit_weights


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(start, "_POINTS", 2_000)


@pytest.fixture
def config():
    return tiny(xa.quick())


def fitted(body, config, cache, seed=0):
    model = fresh_model(body, replace(config, seed=seed))
    return fit_mean_shape(
        model, config.spec, body, steps=2, optimiser=config.optimiser, seed=seed, cache=cache,
        verbose=False,
    )  # fmt: skip


def test_every_fit_has_a_file_of_its_own(toy_body, config, tmp_path):
    """Named by what it depends on: options, seed, and the number of coefficients."""
    faster = replace(config, optimiser=replace(config.optimiser, learning_rate=0.1))
    still = load_body(toy_body.source.path, num_betas=10, num_expression=3)
    runs = [(toy_body, config, 0), (toy_body, faster, 0), (still, config, 0), (toy_body, config, 1)]
    for count, (body, options, seed) in enumerate([*runs, runs[0]]):
        found = fitted(body, options, tmp_path, seed)
        assert len(list(tmp_path.glob("mean-shape-*.npz"))) == min(count + 1, 4)
        again = fitted(body, options, tmp_path, seed)
        assert same(*(eqx.filter(m, eqx.is_array) for m in (found, again)))


@pytest.mark.parametrize("damage", ["cut", "nan"])
def test_a_damaged_file_is_made_again(toy_body, config, tmp_path, damage):
    expected = fitted(toy_body, config, tmp_path)
    (path,) = tmp_path.glob("mean-shape-*.npz")
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-300])
    else:
        arrays, header = load_arrays(path)
        name = next(n for n, v in arrays.items() if v.ndim)
        save_arrays(path, {**arrays, name: np.full_like(arrays[name], np.nan)}, header)
    with pytest.warns(TrainingNotice, match=r"mean-shape-.*The fit to the mean shape is repeated"):
        found = fitted(toy_body, config, tmp_path)
    assert same(*(eqx.filter(m, eqx.is_array) for m in (found, expected)))
    fitted(toy_body, config, tmp_path)  # without a warning


def test_a_folder_that_cannot_be_written_costs_the_file_alone(toy_body, config, tmp_path):
    (tmp_path / "file").write_text("where a folder should be")
    with pytest.warns(TrainingNotice, match=r"was not cached \(.*file.*cache=FOLDER"):
        found = fitted(toy_body, config, tmp_path / "file")
    assert not eqx.tree_equal(found.geometry, fresh_model(toy_body, config).geometry)


def test_a_network_is_fitted_to_the_template_and_a_random_one_is_not(toy_body, config, tmp_path):
    skinning = replace(config.skinning, kind="mlp")
    config = replace(config, skinning=skinning, search=replace(config.search, cached=False))
    for begin, moves in (("template", True), ("random", False)):
        own = replace(config, skinning=replace(skinning, start=begin))
        drawn, found = fresh_model(toy_body, own), fitted(toy_body, own, tmp_path)
        leaves = [
            jax.tree.leaves(eqx.filter(m.skinning, eqx.is_inexact_array)) for m in (drawn, found)
        ]
        changed = [not np.array_equal(a, b) for a, b in zip(*leaves, strict=True)]
        assert all(changed) if moves else not any(changed)
        assert not np.array_equal(drawn.geometry.biases[0], found.geometry.biases[0])


def test_a_network_is_fitted_to_the_persons_joints_and_surface(toy_body, config):
    """Alone, the joints teach it less: ablation A4. The geometry has no part in it."""
    config = replace(config, skinning=replace(config.skinning, kind="mlp"))
    drawn, betas = fresh_model(toy_body, config), np.full(10, 1.5)

    def weights(losses):
        return fit_weights(
            drawn, toy_body, betas, steps=3000, losses=losses, optimiser=config.optimiser, seed=0
        )

    def error(model):
        found = jax.jit(jax.vmap(model.skinning))(canonical_vertices(toy_body, betas))
        return np.abs(np.asarray(found) - np.asarray(toy_body.weights)).sum(1).mean()

    both, alone = weights(config.losses), weights(replace(config.losses, surface=0.0))
    assert error(both) < 0.7 * error(drawn)
    assert error(alone) > 1.1 * error(both)
    assert not eqx.tree_equal(alone.skinning, drawn.skinning)
    assert eqx.tree_equal(both.geometry, drawn.geometry)
