"""Roots of the samples: on the table, polished on the field, and dropped where they vanish."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xavatar_jax.correspondence import start_table
from xavatar_jax.fields import build_model
from xavatar_jax.methods.xavatar.roots import (
    POLISH_TOLERANCE,
    polish_roots,
    replace_frames,
    rows_in_turn,
    search_roots,
)


def posed(skinning, x_c, transforms):
    """Linear blend skinning in float64, written out."""
    weights = np.asarray(jax.jit(jax.vmap(skinning))(x_c), np.float64)
    blended = np.einsum("nj,jab->nab", weights, np.asarray(transforms, np.float64))
    return np.einsum("nab,nb->na", blended[:, :3, :3], x_c) + blended[:, :3, 3]


def gaps(skinning, data, k, rows):
    where = posed(skinning, np.asarray(data.roots.first[k])[rows], data.transforms[k])
    return np.linalg.norm(where - np.asarray(data.samples.x_d[k])[rows], axis=1)


def test_roots_are_found_on_the_table(case):
    data, total = case.data, case.data.samples.x_d.shape[1]
    for k in range(3):
        found = int(data.roots.found[k])
        assert found > 0.9 * total
        assert gaps(case.table, data, k, slice(found)).max() < 2e-5


def test_rows_with_several_roots_come_first_and_those_without_last(case):
    roots = case.data.roots
    width = roots.others.shape[1]
    for k in range(3):
        found, several = int(roots.found[k]), int(roots.several[k])
        valid = np.asarray(roots.valid[k])
        assert valid[:found].all()
        assert not valid[found:].any()
        others = np.asarray(roots.others_valid[k]).any(-1)
        assert others[:several].all()
        assert not others[several:].any()
    assert width == max(int(n) for n in roots.several)
    share = np.asarray(roots.several).sum() / np.asarray(roots.found).sum()
    assert float(roots.share) == pytest.approx(share, rel=1e-6)


def polished(case, data, times=1):
    """Polished by one step at a time, which is one compiled program."""
    for _ in range(times):
        data = polish_roots(case.model, case.table, data, steps=1)
    return data


def test_polished_roots_belong_to_the_field_itself(case):
    skinning, data = case.model.skinning, case.data
    after = polished(case, data, 8)
    rows = np.flatnonzero(np.asarray(after.roots.valid[0]))
    gap = gaps(skinning, after, 0, rows)
    # Between two capsules the coarse table is far from the field: some roots are lost there.
    assert len(rows) > 0.8 * int(data.roots.found[0])
    assert gap.max() < POLISH_TOLERANCE
    assert np.quantile(gap, 0.95) < 1e-5
    assert np.median(gap) <= np.median(gaps(skinning, data, 0, rows))


def test_neutral_points_are_carried_to_the_roots(case, rng):
    """Under an expression that moves the head, after a search and after a polish."""
    model = build_model(case.config.spec, case.body, key=jax.random.key(0), betas=np.zeros(10))
    model = eqx.tree_at(lambda m: m.geometry.moves.table, model, replace_fn=lambda t: t + 0.002)
    smiling = np.float32(0.5 * rng.normal(size=(3, 10)))
    data = eqx.tree_at(lambda d: d.params.expression, case.data, jnp.asarray(smiling))
    search = case.config.search
    searched = search_roots(
        model.geometry, case.table, data, start_table(case.body, search.starts),
        keep=search.keep, atol=search.atol, max_steps=search.max_steps,
    )  # fmt: skip
    for found in (searched, polish_roots(model, case.table, searched, steps=1)):
        for k in range(3):
            roots = found.roots
            condition = model.geometry.condition(jax.tree.map(lambda v, k=k: v[k], data.params))
            carry = jax.jit(jax.vmap(lambda x, c=condition: model.geometry.carry(x, c)))
            for name, valid in (("", roots.valid), ("others", roots.others_valid)):
                root, neutral = (
                    np.asarray(getattr(roots, n)[k])[np.asarray(valid[k])]
                    for n in (name or "first", f"{name}_neutral".lstrip("_"))
                )
                np.testing.assert_allclose(carry(neutral), root, atol=3e-5)
            moved = np.abs(np.asarray(roots.neutral[k] - roots.first[k])).max()
            assert moved > 1e-4


def test_a_root_that_has_vanished_is_dropped_and_may_come_back(case):
    """A point is moved away: the residual alone tells, and only its own row changes."""
    known = polished(case, case.data, 3)
    before = np.asarray(known.roots.valid)
    row = int(np.flatnonzero(before[1])[5])
    for metres in (0.015, 3.0):  # within what one step may do, and beyond
        moved = known.samples.x_d.at[1, row, 0].add(metres)
        away = eqx.tree_at(lambda d: d.samples.x_d, known, moved)
        none = polish_roots(case.model, case.table, away, steps=0)
        changed = before != np.asarray(none.roots.valid)
        assert np.argwhere(changed).tolist() == [[1, row]]
    none = polished(case, away)  # no step of three metres
    assert not none.roots.valid[1, row]
    back = polished(case, eqx.tree_at(lambda d: d.samples.x_d, none, known.samples.x_d))
    assert back.roots.valid[1, row]


def test_rows_that_never_had_a_root_stay_without(case):
    lost = eqx.tree_at(lambda d: d.roots.found, case.data, case.data.roots.found.at[1].set(0))
    assert not np.asarray(polished(case, lost).roots.valid[1]).any()


def test_roots_are_polished_in_turn(case):
    """The frames of a round as in a polish of all of them, and no others; each has its turn."""
    data = case.data
    every = polished(case, data)
    rounds = [rows_in_turn(number, 2, 3).tolist() for number in (1, 2, 3)]
    assert rounds == [[0, 1], [2, 0], [1, 2]]
    assert rows_in_turn(5, 9, 3).tolist() == [0, 1, 2]
    some = polish_roots(case.model, case.table, data, steps=1, rows=np.array([2, 0]))
    for name in ("first", "neutral", "others", "others_neutral"):
        mixed, done, before = (np.asarray(getattr(p.roots, name)) for p in (some, every, data))
        np.testing.assert_allclose(mixed[[0, 2]], done[[0, 2]], atol=1e-7)
        np.testing.assert_array_equal(mixed[1], before[1])
    assert not np.array_equal(every.roots.first, data.roots.first)


def test_replaced_frames_keep_every_shape(case):
    """Also where the new rows with several roots are fewer, or more than there is room for."""
    data = case.data
    width = data.roots.others.shape[1]
    kinds = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), data)
    first = jax.tree.map(lambda leaf: leaf[:1], (data.samples, data.transforms, data.params))
    for wide in (max(width - 1, 0), width + 2):
        rows = np.arange(wide) % max(width, 1)
        roots = replace(
            jax.tree.map(lambda leaf: leaf[:1] if leaf.ndim else leaf, data.roots),
            others=data.roots.others[:1, rows], others_valid=data.roots.others_valid[:1, rows],
            others_neutral=data.roots.others_neutral[:1, rows],
        )  # fmt: skip
        new = replace(data, samples=first[0], transforms=first[1], params=first[2], roots=roots)
        put = replace_frames(data, new, np.array([2]))
        assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), put) == kinds
        np.testing.assert_array_equal(put.samples.x_d[2], data.samples.x_d[0])
        np.testing.assert_array_equal(put.roots.first[2], data.roots.first[0])
        np.testing.assert_array_equal(put.samples.x_d[:2], data.samples.x_d[:2])
