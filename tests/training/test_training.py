"""Steps, draws, determinism and failure of training, on pools made by hand."""

import json
import time
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import tiny
from xavatar_jax.training import (
    PRESETS,
    TrainingError,
    config_from_dict,
    config_to_dict,
    fresh_fields,
    trainable_filter,
)
from xavatar_jax.training import step as step_module
from xavatar_jax.training.loop import train_pool
from xavatar_jax.training.objective import (
    geometry_objective,
    make_anchors,
    skinning_objective,
)
from xavatar_jax.training.pool import (
    label_frames,
    polish_roots,
    rows_in_turn,
    tabulate_for_search,
)
from xavatar_jax.training.progress import progress
from xavatar_jax.training.step import batch_of, draw_batch

import xavatar_jax as xa
from xavatar_jax.fields import MLPShape


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_config_survives_json(preset):
    config = PRESETS[preset]()
    assert config_from_dict(json.loads(json.dumps(config_to_dict(config)))) == config


def test_a_config_of_an_older_file_gets_defaults_for_what_it_lacks():
    values = config_to_dict(xa.quick())
    for name in ("validation", "checkpoint_every", "report_every"):
        del values[name]
    assert config_from_dict(values) == xa.quick()


def test_unknown_config_entry_is_named():
    values = config_to_dict(xa.quick())
    values["search"]["speed"] = 11
    with pytest.raises(ValueError, match=r"config\.search: unknown entry 'speed'"):
        config_from_dict(values)


def test_roots_of_the_pool_are_roots(case):
    """Skinning carries every stored root to its point, to the grid's own accuracy."""
    body, _, config, fields, pool = case
    table = tabulate_for_search(body, np.zeros(10), fields.skinning, config)
    for k in range(3):
        found = int(pool.found[k])
        assert found > 0.9 * pool.points.shape[1]
        posed = jax.vmap(lambda x, b=pool.transforms[k]: xa.skin_points(x, table(x), b))(
            pool.root[k, :found]
        )
        assert np.abs(posed - pool.points[k, :found]).max() < 2e-5


def test_polished_roots_belong_to_the_field_itself(case):
    body, _, config, fields, pool = case
    table = tabulate_for_search(body, np.zeros(10), fields.skinning, config)
    polished = polish_roots(fields.skinning, table, pool, steps=8)
    found = int(pool.found.min())

    def gap(p):
        posed = jax.vmap(lambda x: xa.skin_points(x, fields.skinning(x), pool.transforms[0]))(
            p.root[0, :found]
        )
        return np.linalg.norm(posed - pool.points[0, :found], axis=1)

    assert np.quantile(gap(polished), 0.98) < 1e-5
    assert np.median(gap(polished)) <= np.median(gap(pool))


def test_roots_are_polished_in_turn(case):
    """The frames of a round as in a polish of all of them, and no others; each has its turn."""
    body, _, config, fields, pool = case
    table = tabulate_for_search(body, np.zeros(10), fields.skinning, config)
    every = polish_roots(fields.skinning, table, pool, steps=1)
    rounds = [rows_in_turn(number, 2, 3).tolist() for number in (1, 2, 3)]
    assert rounds == [[0, 1], [2, 0], [1, 2]]
    assert rows_in_turn(5, 9, 3).tolist() == [0, 1, 2]
    some = polish_roots(fields.skinning, table, pool, steps=1, rows=np.array([2, 0]))
    for name in ("root", "others"):
        mixed, done, before = (np.asarray(getattr(p, name)) for p in (some, every, pool))
        np.testing.assert_allclose(mixed[[0, 2]], done[[0, 2]], atol=1e-7)
        np.testing.assert_array_equal(mixed[1], before[1])
    assert not np.array_equal(every.root, pool.root)


def test_batches_take_only_points_with_roots(case):
    _, _, config, _, pool = case
    batch = draw_batch(pool, config, 64, 8, jax.random.key(0))
    known = np.asarray(pool.points).reshape(-1, 3)
    rows = [np.flatnonzero((known == p).all(1))[0] for p in np.asarray(batch.points[0])]
    frame, row = np.divmod(rows, pool.points.shape[1])
    assert (row < np.asarray(pool.found)[frame]).all()
    assert batch.others.shape[:2] == (2, 8)


def test_points_without_a_root_count_for_nothing(case):
    """Of a frame in which none was found: wherever they stand, losses and slopes are the same."""
    body, _, config, fields, pool = case
    lost = eqx.tree_at(
        lambda p: (p.found, p.several), pool, (pool.found.at[1].set(0), pool.several.at[1].set(0))
    )
    batch = batch_of(lost, jnp.array([0, 1]), 64, 8, *jax.random.split(jax.random.key(0)))
    assert np.asarray(batch.rooted).all(axis=1).tolist() == [True, False]
    assert not np.asarray(batch.rooted[1]).any()
    elsewhere = batch._replace(root=jnp.where(batch.rooted[..., None], batch.root, 7.0))
    anchors = make_anchors(body, jnp.zeros(10), config)
    for objective in (geometry_objective, skinning_objective):

        def loss(learned, batch, objective=objective):
            found = eqx.combine(learned, fields)
            return objective(found, batch, anchors, config, jax.random.key(1))[0]

        slope = eqx.filter_jit(jax.value_and_grad(loss))
        learned = eqx.filter(fields, trainable_filter(fields, config))
        one, other = slope(learned, batch), slope(learned, elsewhere)
        assert jax.tree.all(jax.tree.map(np.array_equal, one, other))
        assert float(one[0]) > 0


@pytest.fixture(scope="module")
def trained(case):
    """A run, and how often each objective was traced in it and in a second, shorter one."""
    body, _, config, fields, pool = case
    traces = {"geometry": 0, "skinning": 0}

    def counted(name, objective):
        def wrapped(*args):
            traces[name] += 1
            return objective(*args)

        return wrapped

    jax.clear_caches()
    with pytest.MonkeyPatch.context() as patch:
        for name in traces:
            attribute = f"{name}_objective"
            patch.setattr(step_module, attribute, counted(name, getattr(step_module, attribute)))
        done = train_pool(body, fields, pool, np.zeros(10), config, verbose=False)
        first = dict(traces)
        shorter = replace(config, steps=config.steps - 3, report_every=1)
        train_pool(body, fields, pool, np.ones(10), shorter, verbose=False)
    return done, first, traces


def test_steps_are_traced_once(trained):
    _, first, both = trained
    assert first == both == {"geometry": 1, "skinning": 1}


def test_same_seed_same_numbers(case, trained):
    body, _, config, fields, pool = case
    again = train_pool(body, fields, pool, np.zeros(10), config, verbose=False).fields
    for a, b in zip(jax.tree.leaves(trained[0].fields), jax.tree.leaves(again), strict=True):
        assert np.array_equal(a, b)


def test_only_learned_leaves_change(case, trained):
    _, _, config, fields, _ = case
    after = trained[0].fields
    learned = trainable_filter(fields, config)
    fixed_before = jax.tree.leaves(eqx.filter(fields, learned, inverse=True))
    fixed_after = jax.tree.leaves(eqx.filter(after, learned, inverse=True))
    for a, b in zip(fixed_before, fixed_after, strict=True):
        assert np.array_equal(a, b)
    assert not np.array_equal(fields.geometry.encoding.table, after.geometry.encoding.table)
    assert not np.array_equal(fields.skinning.correction, after.skinning.correction)


def test_fixed_template_weights_stay(case):
    body, _, config, fields, pool = case
    config = replace(config, skinning=replace(config.skinning, learned=False))
    after = train_pool(body, fields, pool, np.zeros(10), config, verbose=False)
    assert np.array_equal(fields.skinning.correction, after.fields.skinning.correction)
    assert not any(name.startswith("skinning") for name in after.history.terms)


def test_a_loss_that_is_not_finite_names_its_term(case):
    body, _, config, fields, pool = case
    bad = eqx.tree_at(lambda p: p.distance, pool, jnp.full_like(pool.distance, jnp.nan))
    with pytest.raises(TrainingError, match="occupancy term is nan at step 1"):
        train_pool(body, fields, bad, np.zeros(10), config, verbose=False)


def test_a_deadline_ends_training(case):
    body, _, config, fields, pool = case
    config = replace(config, steps=100_000)
    deadline = time.perf_counter() + 0.5
    done = train_pool(body, fields, pool, np.zeros(10), config, deadline=deadline, verbose=False)
    assert done.history.steps_done < 5000


@pytest.mark.slow
def test_paper_preset_takes_a_step(case):
    """Its networks, narrower, with roots searched inside the step on the network itself."""
    body, frames, _, _, _ = case
    config = tiny(xa.paper())
    config = replace(
        config,
        steps=2,
        geometry=replace(config.geometry, mlp=MLPShape(width=48)),
        search=replace(config.search, keep=3),
    )
    fields = fresh_fields(body, config)
    with progress("", 3, verbose=False) as bar:
        pool = label_frames(body, frames, config, bar=bar)
    done = train_pool(body, fields, pool, np.zeros(10), config, verbose=False)
    terms = {name: values[-1] for name, values in done.history.terms.items()}
    assert set(terms) == {*("loss", "gradient", "occupancy", "bone", "joint", "surface", "found")}
    assert all(np.isfinite(value) for value in terms.values())
    assert terms["found"] > 0.9


def test_frames_of_another_body_are_refused(case):
    body, frames, config, _, _ = case
    params = eqx.tree_at(lambda p: p.betas, frames.params, jnp.zeros((3, 40)))
    wrong = xa.Frames(params, lambda i: (frames[i].vertices, frames[i].faces))
    with pytest.raises(ValueError, match=r"frames\.params\.betas has shape \(3, 40\)"):
        xa.fit(wrong, config, body=body, verbose=False)
