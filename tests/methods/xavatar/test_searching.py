"""Searches inside a step that run on a table of the field first."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import Case, fresh_model, labelled, posed_frames, same, tiny

import xavatar_jax as xa
from xavatar_jax.correspondence import start_table
from xavatar_jax.fields import GridSpacing, grids_for_search, learned_leaves
from xavatar_jax.methods.xavatar.roots import tabulated
from xavatar_jax.methods.xavatar.stages import DrawAndSearch, RowDraw
from xavatar_jax.methods.xavatar.upkeep import GuideRenewal


@pytest.fixture(scope="module")
def person(bundled_body):
    """The bundled body, on grids fine enough for its own weights, with points of three frames."""
    grid = GridSpacing(body=0.04, hands=0.01, face=0.013, band=0.06)
    config = tiny(xa.quick())
    skinning = replace(xa.quick().skinning, grid=grid)
    points = replace(config.points, body=200, face=60, eyes_mouth=40, hand=100, box=20)
    search = replace(config.search, grid=grid)
    config = replace(config, skinning=skinning, search=search, points=points)
    model = fresh_model(bundled_body, config)
    data = labelled(bundled_body, posed_frames(bundled_body, 3), config)
    return Case(bundled_body, None, config, model, None, data)


@pytest.fixture(scope="module")
def guided(person):
    """A model that has left its template a little, its grids, and searched points of two frames."""
    case = person
    noise = 0.1 * np.random.default_rng(0).standard_normal(case.model.skinning.correction.shape)
    correction = case.model.skinning.correction + np.float32(noise)
    model = eqx.tree_at(lambda m: m.skinning.correction, case.model, correction)
    grids = grids_for_search(model.skinning, case.body, np.zeros(10), case.config.search.grid)
    draw = DrawAndSearch(
        starts=start_table(case.body, "part_aware"), rows=RowDraw(2, 200, 0, 0),
        keep=4, atol=1e-5, max_steps=15,
    )  # fmt: skip

    def search(guide):
        data = replace(case.data, guide=guide)
        return eqx.filter_jit(draw.of_frames)(model, data, jnp.asarray([0, 2]), jax.random.key(3))

    return model, grids, search


@pytest.mark.parametrize("stale", [False, True])
def test_roots_are_the_fields_own_whatever_the_guide_is(person, guided, stale):
    """Also where the guide is of the field some steps before."""
    model, grids, search = guided
    batch = search(tabulated((person.model if stale else model).skinning, grids))
    found = np.asarray(batch.valid)
    assert found.mean() > 0.9
    for k in range(2):
        x_c = np.asarray(batch.root[k], np.float32)
        weights = np.asarray(jax.jit(jax.vmap(model.skinning))(x_c), np.float64)
        blended = np.einsum("nj,jab->nab", weights, np.asarray(batch.transforms[k], np.float64))
        where = np.einsum("nab,nb->na", blended[:, :3, :3], x_c) + blended[:, :3, 3]
        assert np.abs(where - np.asarray(batch.x_d[k]))[found[k]].max() < 5e-5


def test_the_guide_follows_the_field(person, guided):
    model, grids, _ = guided
    data = GuideRenewal(grids, 4)(model, person.data, 4)
    assert same(data.guide, tabulated(model.skinning, grids))
    assert same(data.guide_source, eqx.filter(model.skinning, learned_leaves(model.skinning)))
    assert not same(data.guide, tabulated(person.model.skinning, grids))
