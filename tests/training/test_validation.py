"""Frames to be judged by: which they are, when training ends, which fields are kept."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import posed_frames
from xavatar_jax.training import ValidationConfig, choose_frames
from xavatar_jax.training.loop import train_pool
from xavatar_jax.training.validation import Best, split_validation

import xavatar_jax as xa
from xavatar_jax.frames import frames_from_params


def sequences(lengths, body):
    total = sum(lengths)
    index = np.repeat(np.arange(len(lengths)), lengths)
    names = [f"s{k}" for k in range(len(lengths))]
    params = xa.BodyParams.zeros(body, (total,))
    return frames_from_params(body, params, sequence_names=names, sequence_index=index)


def test_the_last_tenth_of_each_sequence_is_held(family):
    frames = sequences([30, 9, 10, 25], family["smplx"])
    learned, held = split_validation(frames, ValidationConfig(frames=100))
    assert list(held) == [27, 28, 29, 48, 72, 73]
    assert sorted([*learned, *held]) == list(range(74))


def test_few_of_the_held_are_asked_and_the_others_rest(family):
    frames = sequences([100, 100], family["smplx"])
    learned, held = split_validation(frames, ValidationConfig(frames=4))
    assert len(held) == 4
    assert sum(90 <= k < 100 for k in held) == 2
    assert len(learned) == 180
    assert not set(learned) & {*range(90, 100), *range(190, 200)}


@pytest.mark.parametrize("off", [{"share": 0.0}, {"frames": 0}])
def test_no_validation(family, off):
    learned, held = split_validation(sequences([40], family["smplx"]), ValidationConfig(**off))
    assert len(learned) == 40
    assert not len(held)


def test_varied_frames_come_from_what_is_left(case):
    frames = posed_frames(case[0], 40)
    learned, held = choose_frames(frames, replace(case[2], train_frames=6))
    assert len(learned) == 6
    assert max(learned) < 36
    assert list(held) == [36, 37, 38, 39]


def test_small_gains_do_not_count_and_of_equal_losses_the_latest_is_kept():
    config = ValidationConfig(patience=30, gain=0.1)
    fit = replace(xa.paper(), steps=1000, validation=config)
    best = Best()
    stopped = []
    for step, loss in ((10, 1.0), (20, 0.95), (30, 0.8), (40, 0.79), (50, 0.85), (60, 0.9)):
        best.update(step, loss, {"step": jnp.asarray(step)}, config)
        stopped.append(best.plateau(step, fit))
    # 0.85 is within a tenth of the least, 0.79; 0.9 is not.
    assert (best.step, best.loss, int(best.learned["step"])) == (50, 0.85, 50)
    assert stopped == [False] * 5 + [True]  # 30 steps after the gain at 30
    never = replace(fit, validation=replace(config, patience=0))
    assert not best.plateau(900, never)


def test_under_a_falling_rate_a_plateau_counts_from_half_of_the_steps():
    config = replace(xa.quick(), steps=100, validation=ValidationConfig(patience=20))
    best = Best()
    best.update(10, 1.0, {}, config.validation)
    assert [best.plateau(k, config) for k in (40, 69, 70)] == [False, False, True]


@pytest.fixture(scope="module")
def judged(case):
    """A run that is judged on the last of three frames, and its fields by step."""
    body, _, config, fields, pool = case
    validation = replace(config.validation, every=4, points=128)
    config = replace(config, validation=validation, report_every=4)
    seen = {}
    done = train_pool(
        body, fields, pool, np.zeros(10), config, held=1, verbose=False,
        callback=lambda step, fields, terms: seen.update({step: (fields, terms)}),
    )  # fmt: skip
    return done, seen


def test_the_fields_of_the_best_step_are_returned(judged):
    done, seen = judged
    history = done.history
    assert history.validated == [4, 8, 12]
    losses = np.array(history.validation)
    equal = losses <= np.minimum.accumulate(losses) * (1 + ValidationConfig().gain)
    assert history.best_step == np.array(history.validated)[equal][-1]
    for a, b in zip(
        jax.tree.leaves(done.fields), jax.tree.leaves(seen[history.best_step][0]), strict=True
    ):
        assert np.array_equal(a, b)
    assert seen[8][1]["validation"] == history.validation[1]


def test_held_frames_are_not_learned_from(case, judged):
    """Whatever stands in the held frame, the fields are the same."""
    body, _, config, fields, pool = case
    config = replace(config, validation=replace(config.validation, every=4, points=128))
    other = replace(pool, distance=pool.distance.at[2].multiply(-3.0))
    last = {}
    train_pool(
        body, fields, other, np.zeros(10), config, held=1, verbose=False,
        callback=lambda step, fields, terms: last.update(fields=fields, terms=terms),
    )  # fmt: skip
    expected = judged[1][12][0]
    for a, b in zip(jax.tree.leaves(last["fields"]), jax.tree.leaves(expected), strict=True):
        assert np.array_equal(a, b)
    assert last["terms"]["validation"] > 1.5 * judged[1][12][1]["validation"]


def test_validation_is_the_loss_of_the_fields_at_their_roots(case, judged):
    """Against the cross-entropy computed by NumPy at the stored roots, which are exact here."""
    body, _, config, fields, pool = case
    from xavatar_jax.training.objective import make_anchors
    from xavatar_jax.training.validation import make_validation

    config = replace(config, validation=replace(config.validation, points=20_000))
    ask = make_validation(pool, make_anchors(body, jnp.zeros(10), config), config, 1)
    found, several = int(pool.found[2]), int(pool.several[2])
    condition = fields.geometry.condition(jax.tree.map(lambda leaf: leaf[2], pool.params))
    roots = pool.root[2, several:found]
    logit = np.asarray(jax.vmap(lambda x: fields.geometry(x, condition).level)(roots), np.float64)
    scaled = np.asarray(pool.distance[2, several:found], np.float64) / config.losses.softness

    def entropy(z, t):
        return np.logaddexp(0, z) - z * t

    target = 1 / (1 + np.exp(-scaled))
    expected = (entropy(logit, target) - entropy(scaled, target)).mean()
    # Points are drawn with repetition: a sample of as many as there are.
    assert float(ask(fields, pool, None)) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(("schedule", "landing", "steps"), [("constant", 0, 6), ("cosine", 8, 10)])
def test_a_plateau_ends_training(case, schedule, landing, steps):
    """With no loss small enough to count as a gain after the first, at step 4.

    A rate that falls: two steps after half of the twelve, and two more to be at its end.
    """
    body, _, config, fields, pool = case
    validation = replace(config.validation, every=4, points=128, gain=1.0, patience=2)
    optimiser = replace(config.optimiser, schedule=schedule)
    config = replace(config, validation=validation, optimiser=optimiser)
    done = train_pool(body, fields, pool, np.zeros(10), config, held=1, verbose=False)
    history = done.history
    assert (history.stopped, history.steps_done) == ("plateau", steps)
    assert history.landing == landing
