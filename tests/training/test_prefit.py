"""Fields fitted to the mean shape: what they are kept by, and what is fitted."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import tiny
from xavatar_jax.training import (
    TrainingNotice,
    fresh_fields,
    initial_fields,
    prefit,
    settle_on_person,
)

import xavatar_jax as xa
from xavatar_jax.body import canonical_vertices, load_body


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(prefit, "_POINTS", 5_000)


@pytest.fixture
def config():
    return replace(tiny(xa.quick()), prefit_steps=2)


def test_every_fit_has_a_file_of_its_own(toy_body, config, tmp_path):
    """What it depends on names it: options, and how many coefficients of expression there are."""
    faster = replace(config, optimiser=replace(config.optimiser, learning_rate=0.1))
    still = load_body(toy_body.source.path, num_betas=10, num_expression=3)
    for count, (body, options) in enumerate(
        ((toy_body, config), (toy_body, faster), (still, config), (toy_body, config))
    ):
        fitted = initial_fields(body, options, cache=tmp_path, verbose=False)
        assert len(list(tmp_path.glob("prefit-*.npz"))) == min(count + 1, 3)
        again = initial_fields(body, options, cache=tmp_path, verbose=False)
        assert jax.tree.all(jax.tree.map(np.array_equal, *(eqx.filter(f, eqx.is_array)
                                                           for f in (fitted, again))))  # fmt: skip


def test_a_folder_that_cannot_be_written_costs_the_file_alone(toy_body, config, tmp_path):
    (tmp_path / "file").write_text("where a folder should be")
    with pytest.warns(TrainingNotice, match=r"not kept \(.*file.*cache=FOLDER"):
        fitted = initial_fields(toy_body, config, cache=tmp_path / "file", verbose=False)
    assert not eqx.tree_equal(fitted.geometry, fresh_fields(toy_body, config).geometry)


@pytest.mark.parametrize("learned", [True, False])
def test_a_network_is_fitted_to_the_template_whether_or_not_it_is_learned(
    toy_body, config, tmp_path, learned
):
    """The template's weights kept as they are: a network has to be taught them first."""
    config = replace(config, skinning=replace(config.skinning, kind="mlp", learned=learned))
    fitted = initial_fields(toy_body, config, cache=tmp_path, verbose=False)
    drawn = fresh_fields(toy_body, config)
    leaves = zip(jax.tree.leaves(eqx.filter(fitted.skinning, eqx.is_inexact_array)),
                 jax.tree.leaves(eqx.filter(drawn.skinning, eqx.is_inexact_array)),
                 strict=True)  # fmt: skip
    assert all(not np.array_equal(a, b) for a, b in leaves)


def test_detail_reaches_around_the_persons_own_hands(toy_body, config):
    """However far they lie from the mean shape's: fields are the same whether settled or made."""
    hands = toy_body.parts.mask("hands")

    def hands_of(betas):
        return canonical_vertices(toy_body, jnp.asarray(betas, jnp.float32))[hands]

    direction = np.eye(10)[0]
    moved = np.abs(hands_of(direction) - hands_of(0 * direction)).max()
    betas = direction * 0.25 / float(moved)
    drawn = fresh_fields(toy_body, config)
    own = settle_on_person(toy_body, drawn, betas, config)

    def levels(fields):
        return np.asarray(jax.vmap(fields.geometry._level_mask)(hands_of(betas)))

    assert levels(drawn).min() == 0
    assert levels(own).min() == 1
    assert eqx.tree_equal(own, fresh_fields(toy_body, config, betas))
