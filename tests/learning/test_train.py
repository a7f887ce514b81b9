"""The loop: upkeep, validation, plateaus, deadlines, reports, and how a run fails."""

from __future__ import annotations

import json
import signal
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from toy_problem import (
    SGD,
    DrawRows,
    HeldError,
    Points,
    Spoil,
    SquaredError,
    Turn,
    interrupt_at,
    line,
    points,
    run,
    same,
    stage,
)

from xavatar_jax.learning import (
    CONSTANT,
    FALLING,
    Best,
    History,
    Interrupted,
    JsonLines,
    Schedule,
    TrainingError,
    Validation,
    read_log,
    train,
)

HELD = DrawRows(8, held=10)


def train_line(steps, stages=None, data=None, **options):
    schedule = options.pop("schedule", Schedule(steps, report_every=1))
    stages = [stage(draw=HELD)] if stages is None else stages
    data = points() if data is None else data
    return train(line(), data, stages, schedule, verbose=False, **options)


class Watch:
    """Upkeep that notes when it is called, and with what."""

    name, repeatable = "watch", False

    def __init__(self, every, change=lambda data: data):
        self.every, self.change, self.calls = every, change, []

    def __call__(self, model, data, step):
        self.calls.append((step, model, data))
        return self.change(data)


def test_upkeep_is_called_in_order_and_its_data_is_drawn_from():
    doubled = Watch(4, lambda d: Points(d.x, 2 * d.y))
    after = Watch(2)
    seen = {}
    done = train_line(
        9, upkeep=[doubled, after], callback=lambda k, model, terms: seen.update({k: model})
    )
    assert [step for step, *_ in doubled.calls] == [4, 8]
    assert [step for step, *_ in after.calls] == [2, 4, 6, 8]
    # It has the model of its step, and the data that earlier upkeep has made.
    for step, model, _ in doubled.calls:
        assert same(model, seen[step])
    y = np.asarray(points().y)
    scales = [float(data.y[0] / y[0]) for _, _, data in after.calls]
    np.testing.assert_allclose(scales, [1, 2, 2, 4], rtol=1e-6)
    assert done.history.seconds["watch"] > 0
    # The fifth step is the first that draws from what the fourth step's upkeep gave.
    plain = train_line(9).history.terms["error"]
    changed = done.history.terms["error"]
    assert plain[:4] == changed[:4]
    assert plain[4] != changed[4]


def test_the_model_of_upkeep_outlives_the_next_step():
    watch = Watch(1)
    train_line(4, upkeep=[watch])
    slopes = [np.asarray(model.slope) for _, model, _ in watch.calls]  # not freed by donation
    assert len({s.tobytes() for s in slopes}) == 4


def test_small_gains_do_not_count_and_of_equal_losses_the_latest_is_kept():
    best = Best()
    stopped = []
    for step, loss in ((10, 1.0), (20, 0.95), (30, 0.8), (40, 0.79), (50, 0.85), (60, 0.9)):
        best.update(step, loss, {"step": jnp.asarray(step)}, 0.1)
        stopped.append(best.plateau(step, 30))
    # 0.85 is within a tenth of the least, 0.79; 0.9 is not.
    assert (best.step, best.loss, int(best.learned["step"])) == (50, 0.85, 50)
    assert stopped == [False] * 5 + [True]  # 30 steps after the gain at 30
    assert not best.plateau(900, 0)


def test_a_plateau_may_count_from_a_later_step():
    best = Best()
    best.update(10, 1.0, {}, 0.005)
    assert [best.plateau(k, 20, from_step=50) for k in (40, 69, 70)] == [False, False, True]


@pytest.fixture(scope="module")
def judged():
    """A run that is validated on points that it does not learn from, and its models by step."""
    seen = {}
    validation = Validation(HeldError(10), every=4)
    done = train_line(
        12, validation=validation,
        callback=lambda k, model, terms: seen.update({k: (model, terms)}),
    )  # fmt: skip
    return done, seen


def test_the_model_of_the_best_step_is_returned(judged):
    done, seen = judged
    history = done.history
    assert history.validated == [4, 8, 12]
    losses = np.array(history.validation)
    equal = losses <= np.minimum.accumulate(losses) * 1.005
    assert history.best_step == np.array(history.validated)[equal][-1]
    assert same(done.model, seen[history.best_step][0])
    assert seen[8][1]["validation"] == history.validation[1]
    data, model = points(), seen[8][0]
    off = np.asarray(data.x[-10:]) @ np.asarray(model.slope) + 0.25 - np.asarray(data.y[-10:])
    assert history.validation[1] == pytest.approx((off**2).mean(), rel=1e-5)


def test_a_model_that_becomes_worse_is_not_kept():
    """The validation data moves away after step 6."""
    away = Watch(6, lambda d: Points(d.x, d.y + 5.0))
    seen = {}
    done = train_line(
        8, validation=Validation(HeldError(10), every=2), upkeep=[away],
        callback=lambda k, model, terms: seen.update({k: model}),
    )  # fmt: skip
    assert done.history.best_step == 4
    assert same(done.model, seen[4])


def test_without_validation_the_last_model_is_kept():
    seen = {}
    done = train_line(5, callback=lambda k, model, terms: seen.update({k: model}))
    assert done.history.best_step == done.history.steps_done == 5
    assert same(done.model, seen[5])


@pytest.mark.parametrize(("schedule", "landing", "steps"), [(CONSTANT, 0, 6), (FALLING, 8, 10)])
def test_a_plateau_ends_training(schedule, landing, steps):
    """With no loss small enough to count as a gain after the first, at step 4.

    A rate that falls: two steps after half of the twelve, and two more to be at its end.
    """
    validation = Validation(HeldError(10), every=4, gain=1.0, patience=2)
    history = train_line(12, [stage(draw=HELD, schedule=schedule)], validation=validation).history
    assert (history.stopped, history.steps_done) == ("plateau", steps)
    assert history.landing == landing


def test_a_plateau_lets_rates_fall_from_where_they_are():
    """From step 22 of 40, the rest of the curve in two steps."""

    def tilt(model, batch, key):
        return model.slope.sum()

    seen = {}
    tilted = stage(draw=HELD, terms={"tilt": (1.0, tilt)}, schedule=FALLING, optimiser=SGD)
    validation = Validation(HeldError(10), every=2, gain=1.0, patience=2)
    done = train_line(
        40, [tilted], validation=validation,
        callback=lambda k, model, terms: seen.update({k: float(model.slope[0])}),
    )  # fmt: skip
    landing = done.history.landing
    assert (landing, done.history.steps_done) == (22, 24)
    falls = [seen[k] - seen[k + 1] for k in (20, 21, 22, 23)]
    shares = [20 / 40, 21 / 40, 22 / 40, (22 / 40 + 1) / 2]
    expected = [0.1 * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * s))) for s in shares]
    np.testing.assert_allclose(falls, expected, rtol=1e-4)


def test_a_deadline_ends_training():
    schedule = Schedule(10_000_000, deadline=time.perf_counter() + 0.5)
    done = train_line(0, schedule=schedule)
    assert done.history.stopped == "minutes"
    assert 0 < done.history.steps_done < 10_000_000
    late = Schedule(100, deadline=time.perf_counter() - 1)
    assert train_line(0, schedule=late).history.steps_done == 0


def test_reports_go_to_history_log_and_callback(tmp_path):
    heard = {}
    log = tmp_path / "log.jsonl"
    history = History(frames=7, notices=["so"])
    done = train_line(
        5, schedule=Schedule(5, report_every=2), history=history, log=JsonLines(log),
        callback=lambda k, model, terms: heard.update({k: terms}),
    )  # fmt: skip
    assert done.history is history
    assert history.steps == sorted(heard) == [2, 4, 5]
    assert [terms["loss"] for terms in heard.values()] == history.terms["loss"]
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert [r.get("event", r.get("step")) for r in records] == ["start", 2, 4, 5, "stop"]
    assert records[0]["frames"] == 7
    assert records[2]["error"] == history.terms["error"][1]
    assert {"loss", "error", "gradient", "seconds"} <= set(records[2])
    assert records[-1] == {"event": "stop", "step": 5, "reason": "steps", "best": 5}
    assert {"compile", "train"} <= set(history.seconds)


def test_a_log_cut_off_is_read_and_a_damaged_one_is_named(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 25}\n{"step": 50}\n{"ste')
    assert [r["step"] for r in read_log(path)] == [25, 50]
    JsonLines(path, after=25).write({"step": 26, "loss": float("nan")})
    assert read_log(path) == [{"step": 25}, {"step": 26, "loss": None}]
    path.write_text('{"step": 25}\nnot json\n{"step": 50}\n')
    with pytest.raises(ValueError, match=r"log\.jsonl, line 2: not JSON"):
        read_log(path)


def test_histories_are_joined():
    first = History(steps=[2], terms={"a": [1.0]}, seconds={"train": 1.0}, steps_done=3)
    second = History(steps=[2], terms={"b": [2.0]}, seconds={"train": 2.0}, steps_done=4)
    first.append(second)
    assert first.steps == [2, 5]
    assert first.terms["b"][1] == 2.0
    assert np.isnan([first.terms["a"][1], first.terms["b"][0]]).all()
    assert (first.seconds["train"], first.steps_done) == (3.0, 7)
    assert History(**first.to_dict()).to_dict().keys() == first.to_dict().keys()


@pytest.mark.parametrize("every", [4, 7])
def test_a_loss_that_is_not_finite_keeps_the_last_good_state(every):
    """In the seventh step: the model kept is that after six, whatever stage takes the eighth."""
    seen = {}
    with pytest.raises(TrainingError, match=r"the error term is nan at step 7") as error:
        run(
            every=every, upkeep=(Spoil(6),), validation=None,
            callback=lambda k, model, terms: seen.update({k: model}),
        )  # fmt: skip
    assert (error.value.step, error.value.term) == (7, "error")
    history = error.value.fitted.history
    assert (history.steps_done, history.stopped) == (6, "not finite")
    assert same(error.value.fitted.model, seen[6])


def test_a_term_that_is_not_finite_is_found_between_two_reports():
    """Also where the clock ends the run: here, in the last step, long before a report."""
    with pytest.raises(TrainingError, match="error term is nan at step 7"):
        train_line(0, schedule=Schedule(7, report_every=100), upkeep=[Spoil(6)])


def test_an_infinite_gradient_of_a_finite_loss_is_named():
    def root(model, batch, key):
        # The root of zero: its value is zero, its slope is infinite.
        return jnp.sqrt(0.0 * model.slope.sum())

    steep = stage(terms={"error": (1.0, SquaredError()), "root": (1.0, root)})
    with pytest.raises(TrainingError, match="the gradient term is nan at step 1"):
        train_line(3, [steep])


def test_a_validation_that_is_not_finite_is_named():
    class Nothing(eqx.Module):
        def __call__(self, model, data):
            return jnp.nan

    with pytest.raises(TrainingError, match="the validation term is nan at step 2"):
        train_line(4, validation=Validation(Nothing(), every=2))


def test_an_interrupt_without_a_checkpoint_says_so_and_gives_the_model():
    handler = signal.getsignal(signal.SIGINT)
    seen = {}

    def callback(k, model, terms):
        seen[k] = model
        interrupt_at(6)(k, model, terms)

    with pytest.raises(Interrupted, match=r"step 7 of 12: nothing was saved") as stopped:
        train_line(12, callback=callback)
    assert isinstance(stopped.value, KeyboardInterrupt)
    assert (stopped.value.signal, stopped.value.step) == (signal.SIGINT, 7)
    assert stopped.value.fitted.history.stopped == "interrupt"
    assert same(stopped.value.fitted.model, seen[7])
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_turned_order_is_another_run():
    """What the upkeep of the checkpoint tests does has an effect."""
    assert not same(run().model, run(upkeep=()).model)
    assert same(run().model, run(upkeep=(Turn(),)).model)
