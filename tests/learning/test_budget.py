"""Deadlines: steps are timed, their number is planned once, and rates fall until then."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pytest
from toy_problem import Turn, interrupt_at, run, same

from xavatar_jax.files import load_arrays
from xavatar_jax.learning import Interrupted, Pace, check_minutes, read_log


class Clock:
    """`time.perf_counter` by hand."""

    def __init__(self, monkeypatch):
        self.now = 100.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)


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


@pytest.mark.parametrize("minutes", [0, -1.0, float("nan"), float("inf")])
def test_budgets_are_positive(minutes):
    with pytest.raises(ValueError, match="minutes must be a positive number"):
        check_minutes(minutes)
    check_minutes(None)
    check_minutes(0.5)


@dataclass(frozen=True)
class Rest:
    """Upkeep that makes steps slow."""

    every: int = 1
    name: str = "rest"
    repeatable: bool = False

    def __call__(self, model, data, step):
        time.sleep(0.03)
        return data


def test_a_plan_is_kept_by_a_run_that_is_resumed(tmp_path):
    """Once there is a plan the run is stopped; it then ends where the plan said."""
    path, log = tmp_path / "run.npz", tmp_path / "log.jsonl"
    upkeep, sent = (Turn(), Rest()), []
    slow = {"steps": 100_000, "upkeep": upkeep, "log": log}

    def stop(k, model, terms):
        if not sent and any(r.get("event") == "plan" for r in read_log(log)):
            sent.append(k)  # a second signal would act as usual
            interrupt_at(k)(k, model, terms)

    with pytest.raises(Interrupted) as stopped:
        run(path, callback=stop, deadline=time.perf_counter() + 5.0, **slow)
    plans = [r for r in read_log(log) if r.get("event") == "plan"]
    assert len(plans) == 1
    planned = stopped.value.fitted.history.planned
    assert planned == plans[0]["steps"] > stopped.value.step
    assert int(load_arrays(path)[0]["state:decay.end"]) == planned
    # Without the rest: the plan is not made again, whatever the steps take now.
    slow["upkeep"] = (Turn(),)
    later = time.perf_counter() + 600
    resumed = run(path, resume=True, deadline=later, **slow)
    history = resumed.history
    assert (history.steps_done, history.planned, history.stopped) == (planned, planned, "minutes")
    again = run(path, resume=True, deadline=later, **slow)
    assert again.history.steps_done == planned
    assert same(again.model, resumed.model)


def test_a_plan_lets_rates_fall_to_their_end(tmp_path):
    """The last updates are a hundredth as large as the rate says."""
    log, seen = tmp_path / "log.jsonl", {}
    done = run(
        steps=100_000, upkeep=(Rest(),), log=log, deadline=time.perf_counter() + 4.0,
        validation=None, callback=lambda k, model, terms: seen.update({k: model}),
    )  # fmt: skip
    history = done.history
    assert history.stopped == "minutes"
    assert 0 < history.steps_done <= history.planned < 1000
    moves = [
        np.abs(np.asarray(seen[b].slope - seen[a].slope)).max()
        for a, b in zip(history.steps, history.steps[1:], strict=False)
    ]
    assert moves[-1] < 0.2 * max(moves)
