"""The training loop of every method."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Generic, NoReturn, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .._version import __version__
from .budget import Pace
from .checkpoint import Keeper
from .devices import ONE_DEVICE, Devices
from .record import History, JsonLines, progress
from .stage import CONSTANT, Decay, Setup, Stage, stage_at, update
from .stopping import Interrupted, StopFlag, TrainingError, stop_between_steps
from .validation import Best, Validation

M = TypeVar("M")
Callback = Callable[[int, Any, dict[str, float]], None]
"""Called as `callback(step, model, terms)` at every report."""


class Upkeep(Protocol):
    """Work between steps that changes the data: `upkeep(model, data, step) -> data`.

    - `name`: the activity that its time is booked on.
    - `every`: steps between two calls.
    - `repeatable`: whether a call has no side effects, so that it may be timed for a plan.
    """

    @property
    def name(self) -> str: ...
    @property
    def every(self) -> int: ...
    @property
    def repeatable(self) -> bool: ...
    def __call__(self, model: Any, data: Any, step: int) -> Any: ...


@dataclass(frozen=True)
class Schedule:
    """How long a run is, and how often it reports.

    - `steps`, `deadline`: whichever ends first. The deadline is a time of `time.perf_counter`; if
      rates fall, the number of steps that it holds is measured once, and they fall until then.
    - `seed`: keys every draw, together with the step number.
    - `report_every`: steps between two records of the terms, log lines and callbacks.
    - `checkpoint_every`: steps between two checkpoints.
    """

    steps: int
    deadline: float | None = None
    seed: int = 0
    report_every: int = 25
    checkpoint_every: int = 250


@dataclass(frozen=True)
class Trained(Generic[M]):
    """The model that was kept, and the history of the run."""

    model: M
    history: History


def train(
    model: M,
    data: Any,
    stages: Sequence[Stage],
    schedule: Schedule,
    *,
    upkeep: Sequence[Upkeep] = (),
    validation: Validation | None = None,
    history: History | None = None,
    keeper: Keeper | None = None,
    log: JsonLines | None = None,
    callback: Callback | None = None,
    devices: Devices = ONE_DEVICE,
    verbose: bool = True,
    name: str = "training",
    options: Mapping[str, Any] | None = None,
) -> Trained[M]:
    """Train a model until the step budget, the deadline, a plateau or an interrupt.

    - `data`: a pytree that stages draw from and that upkeep replaces.
    - `stages`: see `Stage`; `upkeep`: see `Upkeep`, called in order.
    - `validation`: decides which model is kept and when the loss has stopped falling. Without it
      the last model is kept.
    - `history`: continued if given.
    - `keeper`: writes checkpoints; if it has a saved one, the run continues from there, bit for
      bit on the same machine.
    - `devices`: share each step.
    - `name`: of the progress bar and in messages; `options`: for the first line of the log.

    **Raises:** `ValueError` for stages that learn nothing; `TrainingError` naming the term that is
    not finite; `Interrupted` after Ctrl-C or SIGTERM. Both carry what was learned as `fitted`, a
    `Trained`.
    """
    loop = _Loop(
        model, data, tuple(stages), schedule, tuple(upkeep), validation,
        History() if history is None else history, keeper, log, callback, devices, name,
        options or {},
    )  # fmt: skip
    return loop.run(verbose=verbose and loop.first)


class _Loop:
    """The state of a run, and the events that change it."""

    def __init__(
        self,
        model: Any,
        data: Any,
        stages: tuple[Stage, ...],
        schedule: Schedule,
        upkeep: tuple[Upkeep, ...],
        validation: Validation | None,
        history: History,
        keeper: Keeper | None,
        log: JsonLines | None,
        callback: Callback | None,
        devices: Devices,
        name: str,
        options: Mapping[str, Any],
    ):
        self.clock = time.perf_counter()
        self.schedule, self.upkeep, self.validation = schedule, upkeep, validation
        self.history, self.keeper, self.log = history, keeper, log
        self.callback, self.devices, self.name = callback, devices, name
        self.first = jax.process_index() == 0  # the host that writes
        self.stages: tuple[Stage, ...] = devices.replicate(stages)
        state, setup = Setup.create(devices.replicate(model), stages, schedule.steps)
        self.model = model  # whose frozen leaves the results share
        self.best, self.latest, self.at = Best(), {}, 0
        saved = None if keeper is None else keeper.saved
        if saved is not None:
            self.best = saved.best(state.learned)
            self.best = replace(self.best, learned=devices.replicate(self.best.learned))
            self.latest.update(saved.header["latest"])
            state, self.at = saved.state(state), saved.step
            if not self.history.planned:  # also where the caller has discarded an earlier plan
                state = eqx.tree_at(lambda s: s.decay, state, Decay.create(schedule.steps))
        self.state, self.setup = devices.replicate(state), devices.replicate(setup)
        self.data = devices.replicate(data)
        self.seed = devices.replicate(jnp.asarray(schedule.seed, jnp.uint32))
        self.falls = any(stage.schedule is not CONSTANT for stage in stages)
        self.pace = None
        if schedule.deadline is not None and not history.planned and self.falls:
            cycle = reduce(math.lcm, (stage.every for stage in stages))
            self.pace = Pace(cycle, schedule.deadline)
        self.extra_s = 0.0  # a step's share of validation and upkeep
        self.began, self.trained = self.at, history.seconds.get("train", 0.0)
        self.compiled: set[str] = set()
        self.unchecked: tuple[int, dict[str, Any]] | None = None
        self._write(
            {
                "event": "start" if saved is None else "resume",
                "step": self.at,
                "version": __version__,
                "jax": jax.__version__,
                "devices": devices.count,
                "frames": history.frames,
                "options": dict(options),
            }
        )
        self._book("compile")

    @property
    def total(self) -> int:
        """The number of steps, if nothing ends the run earlier."""
        return min(self.history.planned or self.schedule.steps, self.schedule.steps)

    def run(self, *, verbose: bool) -> Trained[Any]:
        """Take steps until there is a reason to stop."""
        with progress(self.name, self.total, verbose=verbose, unit="step") as bar:
            bar.update(self.at)
            with stop_between_steps() as flag:
                reason = self._stop_reason(flag)
                while not reason:
                    self._advance()
                    bar.update(1)
                    reason = self._between(flag, bar)
        if self.validation is not None and self.at not in self.history.validated:
            self._validate()
        self._finish(reason)
        return self._fitted()

    def _fitted(self) -> Trained[Any]:
        """The best model so far, or the latest if there is no validation."""
        learned = self.state.learned if self.best.learned is None else self.best.learned
        learned = self.devices.collect(jax.tree.map(jnp.copy, learned))
        return Trained(eqx.combine(learned, self.model), self.history)

    def _advance(self) -> None:
        """Dispatch one step, and check the one before it while this one runs."""
        stage = stage_at(self.stages, self.at)
        fresh = stage.name not in self.compiled
        if fresh:
            self._book("train")
        k = self.devices.replicate(jnp.asarray(self.at, jnp.int32))
        constant = (stage, self.setup, self.data, self.seed, k, self.devices)
        self.state, terms = update(constant, self.state)
        self.at += 1
        previous, self.unchecked = self.unchecked, (self.at, terms)
        self._check(previous)
        self.latest.update(terms)  # pyright: ignore[reportArgumentType, reportCallIssue]
        if fresh:
            self._check_all()
            self.compiled.add(stage.name)
            self._book("compile")

    def _between(self, flag: StopFlag, bar: Any) -> str:
        """Run the periodic work that is due after a step. Returns the stop reason, or ""."""
        k, schedule = self.at, self.schedule
        if self.pace is not None:
            self._plan(self.pace, bar)
        for upkeep in self.upkeep:
            if k % upkeep.every == 0:
                self._check_all()
                self._book("train")
                self.data = upkeep(self._model(), self.data, k)
                jax.block_until_ready(self.data)
                self._book(upkeep.name)
        if self.validation is not None and k % self.validation.every == 0:
            self._check_all()
            self._validate()
        self._land(bar)
        reason = self._stop_reason(flag)
        kept = self.keeper is not None and (bool(reason) or k % schedule.checkpoint_every == 0)
        if k % schedule.report_every == 0 or kept or reason:
            self._check_all()
            self._report(bar)
        if kept:
            self.history.stopped = reason
            self._save()
        if reason == "interrupt":
            self._interrupt(flag)
        return reason

    def _stop_reason(self, flag: StopFlag) -> str:
        if self.at >= self.total:
            if self.history.landing:
                return "plateau"
            return "steps" if self.total >= self.schedule.steps else "minutes"
        if not self.falls and self._on_plateau(0):
            return "plateau"
        # Hosts have their own clocks and signals: they ask each other, but not at every step.
        if jax.process_count() > 1 and self.at % self.schedule.report_every:
            return ""
        self._book("train")
        deadline = self.schedule.deadline
        late = deadline is not None and time.perf_counter() > deadline
        if self.devices.agree(flag.number != 0):
            return "interrupt"
        return "minutes" if self.devices.agree(late) else ""

    def _on_plateau(self, from_step: int) -> bool:
        validation = self.validation
        return validation is not None and self.best.plateau(
            self.at, validation.patience, from_step=from_step
        )

    def _plan(self, pace: Pace, bar: Any) -> None:
        """Once enough steps are timed, let the rates fall to their end at the deadline.

        The planned number is part of history and checkpoint, so that a resumed run has it too.
        """
        if pace.since is None:
            due = {stage_at(self.stages, k).name for k in range(pace.cycle)}
            if due <= self.compiled and self.at % pace.cycle == 0:
                self._check_all()
                self._book("train")
                self.extra_s = self._time_extras()
                self._book("compile")
                pace.start()
            return
        if not pace.enough():
            return
        self._check_all()
        steps = self.devices.least(pace.steps_left(self.extra_s))
        end = min(self.at + steps, self.schedule.steps)
        self.pace = None
        self._end_at(end, Decay.create(end), "plan", bar)

    def _time_extras(self) -> float:
        """Seconds of validation and upkeep a step."""
        model = self._model()
        works: list[tuple[int, Callable[[], Any]]] = []
        if self.validation is not None:
            validation = self.validation
            works.append((validation.every, lambda: validation(model, self.data)))
        for upkeep in self.upkeep:
            if upkeep.repeatable:
                works.append((upkeep.every, lambda u=upkeep: u(model, self.data, self.at)))
        extra = 0.0
        for every, work in works:
            jax.block_until_ready(work())  # compiles
            clock = time.perf_counter()
            jax.block_until_ready(work())
            extra += (time.perf_counter() - clock) / every
        return extra

    def _land(self, bar: Any) -> None:
        """On a plateau, let falling rates fall within the patience, and stop there.

        The fall often gains more than all the steps before it at the old rate.
        """
        if not self.falls or self.history.landing or self.pace is not None:
            return
        if self.validation is None or self.at + self.validation.patience >= self.total:
            return
        # A loss that stands still under a high rate often falls again as the rate does.
        if self._on_plateau(self.total // 2):
            self.history.landing = self.at
            end = self.at + self.validation.patience
            decay = Decay.create(end, since=self.at, share=self.at / self.total)
            self._end_at(end, decay, "plateau", bar)

    def _end_at(self, step: int, decay: Decay, event: str, bar: Any) -> None:
        self.history.planned = step
        self.state = eqx.tree_at(lambda s: s.decay, self.state, self.devices.replicate(decay))
        bar.total = self.total
        self._write({"event": event, "step": self.at, "steps": self.total})

    def _model(self) -> Any:
        return self.setup.model(self.state)

    def _validate(self) -> None:
        assert self.validation is not None
        self._book("train")
        loss = self.validation(self._model(), self.data)
        if not math.isfinite(loss):
            self._fail(self.at, "validation", loss)
        self.best.update(self.at, loss, self.state.learned, self.validation.gain)
        self.history.validated.append(self.at)
        self.history.validation.append(loss)
        self._book("validation")

    def _report(self, bar: Any) -> None:
        """Write the terms to history, progress bar, log and callback."""
        k, history = self.at, self.history
        values = {name: float(value) for name, value in self.latest.items()}
        self.latest = dict(values)
        if k not in history.steps:
            history.record(k, values)
        self._book("train")
        history.steps_done, history.best_step = k, self.best.step or k
        if history.validated and history.validated[-1] == k:
            values["validation"] = history.validation[-1]
        used = history.seconds["train"] - self.trained
        rate = (k - self.began) / max(used, 1e-9)
        bar.set_postfix(loss=f"{values.get('loss', math.nan):.4f}", steps_s=f"{rate:.1f}")
        self._write({"step": k, "seconds": history.seconds["train"], **values})
        if self.callback is not None and self.first:
            learned = self.devices.collect(jax.tree.map(jnp.copy, self.state.learned))
            self.callback(k, eqx.combine(learned, self.model), values)

    def _save(self) -> None:
        if self.keeper is None or not self.first:
            return
        self._book("train")
        self.keeper.save(self.state, self.best, self.history, self.data, self.latest, self.devices)
        self._book("checkpoint")

    def _finish(self, reason: str) -> None:
        history = self.history
        self._book("train")
        history.steps_done, history.stopped = self.at, reason
        history.best_step = self.at if self.best.learned is None else self.best.step
        self._write({"event": "stop", "step": self.at, "reason": reason, "best": history.best_step})

    def _check_all(self) -> None:
        """Wait for the latest step, and check its terms."""
        previous, self.unchecked = self.unchecked, None
        self._check(previous)

    def _check(self, outcome: tuple[int, dict[str, Any]] | None) -> None:
        """Stop if a term is not finite."""
        if outcome is None:
            return
        step, terms = outcome
        values = {name: float(value) for name, value in jax.device_get(terms).items()}
        # Total and gradient come last: they are not finite because a term is not.
        for name in sorted(values, key=lambda n: (n.endswith("gradient"), n.endswith("loss"))):
            if not math.isfinite(values[name]):
                self._fail(step, name, values[name])

    def _fail(self, step: int, name: str, value: float) -> NoReturn:
        """Keep the last good state, and report the term."""
        # Neither the failed step nor the one dispatched after it has changed the state.
        self.at = int(self.state.step)
        latest = {n: float(v) for n, v in self.latest.items()}
        self.latest = {n: v for n, v in latest.items() if math.isfinite(v)}
        self._finish("not finite")
        self._save()
        where = "as this error's `fitted`"
        if self.keeper is not None:
            where = f"in {self.keeper.path}"
        raise TrainingError(
            f"the {name} term is {value} at step {step}; training stopped. The state before that "
            f"step is kept {where}. Lower the learning rate, or look for a frame whose mesh does "
            "not match its parameters.",
            step=step,
            term=name,
            fitted=self._fitted(),
        )

    def _interrupt(self, flag: StopFlag) -> NoReturn:
        """Report what was kept, and how to resume."""
        self._finish("interrupt")
        kept = (
            "nothing was saved, because no checkpoint was requested (checkpoint=FILE); the model "
            "so far is this error's `fitted`"
        )
        if self.keeper is not None:
            kept = (
                f"the run is saved in {self.keeper.path}; repeat the call with resume=True to "
                "continue"
            )
        raise Interrupted(
            f"{self.name} stopped at step {self.at} of {self.total}: {kept}.",
            step=self.at,
            signal=flag.number,
            fitted=self._fitted(),
        )

    def _book(self, activity: str) -> None:
        self.clock = self.history.lap(activity, self.clock)

    def _write(self, record: dict[str, Any]) -> None:
        if self.log is not None:
            self.log.write(record)
