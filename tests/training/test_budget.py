"""Budgets of minutes: frames by the config alone, steps planned once, the schedule to its end."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import posed_frames

import xavatar_jax as xa
from xavatar_jax.files import load_arrays
from xavatar_jax.training import TrainingNotice, budget, choose_frames, loop
from xavatar_jax.training.budget import Pace, frames_in_budget
from xavatar_jax.training.config import config_from_dict, config_to_dict
from xavatar_jax.training.step import Fall, rate_factor


class Clock:
    """`time.perf_counter` by hand."""

    def __init__(self, monkeypatch):
        self.now = 100.0
        monkeypatch.setattr(budget.time, "perf_counter", lambda: self.now)


@pytest.mark.parametrize(
    ("minutes", "train_frames", "expected"),
    [(None, 200, 200), (None, 0, 0), (1.5, 200, 30), (4.0, 200, 180), (60.0, 200, 200),
     (2.0, 0, 60), (0.0, 200, 24), (1.0, 10, 10)],
)  # fmt: skip
def test_frames_of_a_budget(minutes, train_frames, expected):
    config = replace(xa.quick(), minutes=minutes, train_frames=train_frames)
    assert frames_in_budget(config) == expected
    assert frames_in_budget(replace(config, frames_per_minute=0)) == train_frames


def test_frames_left_out_are_said(family):
    frames = posed_frames(family["smplx"], 30)
    config = replace(xa.quick(), minutes=0.5)
    with pytest.warns(TrainingNotice, match=r"24 of 27 frames are learned from: 0\.5 minutes"):
        learned, held = choose_frames(frames, config)
    assert (len(learned), len(held)) == (24, 3)


def test_a_pace_counts_the_steps_that_are_left(monkeypatch):
    """Steps of two seconds, 0.5 more for other work: 0.95 of 1000 - 48 s hold 361."""
    clock = Clock(monkeypatch)
    pace = Pace(cycle=4, deadline=1100.0)
    assert not pace.enough()
    pace.start()
    done = 0
    while not pace.enough():
        clock.now += 2.0
        done += 1
    assert done == 23  # the first of 24 was asked about before it was done
    clock.now += 2.0
    assert pace.steps_left(0.5) == int(0.95 * (1000 - 48) / 2.5)


def test_slow_steps_are_timed_less_and_whole_cycles_long(monkeypatch):
    clock = Clock(monkeypatch)
    pace = Pace(cycle=4, deadline=200.0)
    pace.start()
    done = 0
    while True:
        clock.now += 1.0
        done += 1
        if pace.enough():
            break
    assert done == 8  # more than five seconds, and twice four steps
    clock.now = 250.0
    assert pace.steps_left(0.0) == 1  # late already: one more, and an end


def factor(config, step, fall):
    return float(rate_factor(config, jnp.asarray(step), fall))


def test_a_falling_rate_ends_at_a_hundredth_of_any_total():
    config = xa.quick()
    for total in (10, 1500):
        left = [factor(config, k, Fall.create(total)) for k in (0, total)]
        np.testing.assert_allclose(left, [1.0, 0.01], rtol=1e-5)
    middle = factor(config, 50, Fall.create(100))
    np.testing.assert_allclose(middle, (1 + 0.01) / 2, rtol=1e-5)
    config = replace(config, optimiser=replace(config.optimiser, schedule="constant"))
    assert factor(config, 9, Fall.create(10)) == 1.0


def test_an_end_that_comes_nearer_is_fallen_to_from_where_the_rate_is():
    config = xa.quick()
    whole, near = Fall.create(1000), Fall.create(700, since=600, share=0.6)
    for step, same in ((600, 600), (650, 800), (700, 1000)):
        np.testing.assert_allclose(
            factor(config, step, near), factor(config, same, whole), rtol=1e-5
        )


def test_rates_rise_in_equal_parts_and_multiply_what_falls():
    config = xa.quick()
    rising = replace(config, optimiser=replace(config.optimiser, warmup=4))
    for k, part in enumerate((0.25, 0.5, 0.75, 1.0, 1.0)):
        expected = part * factor(config, k, Fall.create(100))
        np.testing.assert_allclose(factor(rising, k, Fall.create(100)), expected, rtol=1e-6)


def test_a_plan_is_kept_by_a_run_that_goes_on(case, no_prefit, tmp_path, monkeypatch):
    body, _, config, _, pool = case
    frames = posed_frames(body, 12)
    config = replace(config, steps=100_000, minutes=60.0, train_frames=2, report_every=10)
    # Two frames and one to be judged by, whose points are there; twenty steps after those timed.
    monkeypatch.setattr(loop, "label_frames", lambda *_, **__: pool)
    monkeypatch.setattr(loop, "find_roots", lambda *_, **__: pool)
    monkeypatch.setattr(Pace, "steps_left", lambda self, extra: 20)
    path, log = tmp_path / "run.npz", tmp_path / "log.jsonl"

    def call(config=config, **options):
        return xa.fit(frames, config, body=body, verbose=False, checkpoint=path, log=log, **options)

    first = call()
    plans = [r for r in map(json.loads, log.read_text().splitlines()) if r.get("event") == "plan"]
    assert len(plans) == 1
    assert first.history.planned == plans[0]["steps"] == plans[0]["step"] + 20
    assert first.history.steps_done == first.history.planned
    assert first.history.stopped == "minutes"
    assert int(load_arrays(path)[0]["state:fall.end"]) == first.history.planned
    again = call(resume=True)
    assert again.history.steps_done == first.history.planned
    for a, b in zip(
        jax.tree.leaves(first.avatar.fields), jax.tree.leaves(again.avatar.fields), strict=True
    ):
        assert np.array_equal(a, b)
    more = replace(config, minutes=None, steps=first.history.planned + 4)
    longer = call(config=more, resume=True)
    assert longer.history.steps_done == first.history.planned + 4
    assert longer.history.planned == 0


def test_old_configs_have_no_limit_of_their_own():
    values = config_to_dict(xa.quick())
    del values["frames_per_minute"]
    assert config_from_dict(values) == xa.quick()
