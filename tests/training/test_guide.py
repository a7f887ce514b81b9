"""Searches inside a step that run on a table of the field first."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from xavatar_jax.training.config import has_guide
from xavatar_jax.training.loop import train_pool
from xavatar_jax.training.model import trainable_filter
from xavatar_jax.training.objective import search_batch
from xavatar_jax.training.pool import tabulate_for_search
from xavatar_jax.training.run import Run
from xavatar_jax.training.step import draw_batch


@pytest.fixture(scope="module")
def guided(case):
    """A field that has left its template a little, a batch, and the config of guided searches."""
    body, _, config, fields, pool = case
    noise = 0.1 * np.random.default_rng(0).standard_normal(fields.skinning.correction.shape)
    skinning = eqx.tree_at(
        lambda s: s.correction, fields.skinning, fields.skinning.correction + np.float32(noise)
    )
    config = replace(config, search=replace(config.search, cached=False, guide_every=4, keep=4))
    batch = draw_batch(pool, config, 200, 0, jax.random.key(3))
    return body, fields, skinning, batch, config


def posed(skinning, x_c, transforms):
    """Linear blend skinning in float64, written out."""
    weights = np.asarray(jax.jit(jax.vmap(skinning))(x_c.astype(np.float32)), np.float64)
    blended = np.einsum("nj,jab->nab", weights, np.asarray(transforms, np.float64))
    return np.einsum("nab,nb->na", blended[:, :3, :3], x_c) + blended[:, :3, 3]


@pytest.mark.parametrize("stale", [False, True])
def test_roots_are_the_fields_own_whatever_the_guide_shows(guided, stale):
    """Also where the guide is of a field some steps before."""
    body, fields, skinning, batch, config = guided
    shown = fields.skinning if stale else skinning
    guide = tabulate_for_search(body, np.zeros(10), shown, config)
    find = eqx.filter_jit(lambda guide: search_batch(skinning, guide, batch, config, body.tree))
    roots, valid = (np.asarray(a) for a in find(guide))
    plain, plain_valid = (np.asarray(a) for a in find(None))
    assert plain_valid.any(-1).mean() > 0.9
    for k in range(len(roots)):
        point, row = np.nonzero(valid[k])
        found = posed(skinning, roots[k][point, row].astype(np.float64), batch.transforms[k])
        assert np.abs(found - np.asarray(batch.points[k])[point]).max() < 5e-5
    # What the plain search finds is among them.
    gap = np.linalg.norm(roots[:, :, None] - plain[:, :, :, None], axis=-1)
    gap = np.where(valid[:, :, None], gap, np.inf).min(-1)
    assert (gap[plain_valid] < 1e-3).mean() > 0.98


@pytest.fixture
def shown(monkeypatch):
    """Steps at which a guide was made, each with the leaves that it was made of."""
    made = []
    tabulated = Run._tabulated

    def look(self, learned):
        made.append((self.at, jax.tree.map(np.array, learned)))
        return tabulated(self, learned)

    monkeypatch.setattr(Run, "_tabulated", look)
    return made


def test_the_guide_is_that_of_the_last_round(guided, case, shown):
    """Made from the start, and anew after every fourth step."""
    body, fields, _, _, config = guided
    seen = {}
    train(body, fields, case[4], replace(config, steps=10, report_every=1), seen)
    assert [at for at, _ in shown] == [0, 4, 8]
    for at, learned in shown[1:]:
        own = eqx.filter(seen[at], trainable_filter(seen[at], config)).skinning
        assert eqx.tree_equal(jax.tree.map(np.array, own), learned)


def test_a_field_that_is_not_learned_is_tabulated_once(guided, case, shown):
    body, fields, _, _, config = guided
    kept = replace(config.skinning, learned=False)
    train(body, fields, case[4], replace(config, steps=9, skinning=kept), {})
    assert [at for at, _ in shown] == [0]


def train(body, fields, pool, config, seen):
    train_pool(
        body, fields, pool, np.zeros(10), config, verbose=False,
        callback=lambda step, fields, terms: seen.update({step: fields}),
    )  # fmt: skip


def test_stored_roots_have_no_guide(guided, case):
    assert has_guide(guided[4])
    assert not has_guide(case[2])
    assert not has_guide(replace(case[2], search=replace(case[2].search, guide_every=5)))
