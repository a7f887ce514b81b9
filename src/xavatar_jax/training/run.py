"""One run of training: steps, and what is done between them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from .._version import __version__
from ..body import BodyModel
from ..fields import PartGrids, TabulatedSkinning
from .budget import Pace
from .checkpoint import Keeper
from .config import FitConfig, config_to_dict, has_guide
from .devices import Devices
from .errors import Interrupted, TrainingError
from .history import History
from .interrupt import StopFlag, stop_between_steps
from .log import JsonLines
from .model import AvatarFields
from .objective import ExtraTerms, make_anchors
from .pool import FramePool, grids_for_search, polish_roots, rows_in_turn, tabulate_on
from .progress import progress
from .redraw import Redraw, put_rows
from .step import Fall, make_steps, with_learned
from .validation import Best, make_validation

Callback = Callable[[int, AvatarFields, dict[str, float]], None]
"""Called as `callback(step, fields, terms)` now and then while a run goes on."""


@dataclass(frozen=True)
class Fitted:
    """Fields at step 0 and at the end, the way between, and the frames learned from."""

    initial: AvatarFields
    fields: AvatarFields
    history: History
    learned_from: Int[np.ndarray, " t"]


class Run:
    """A run's state, and what changes it. See `train_pool` for the arguments."""

    def __init__(
        self,
        body: BodyModel,
        start: AvatarFields,
        pool: FramePool,
        betas: Any,
        config: FitConfig,
        *,
        held: int,
        deadline: float | None,
        callback: Callback | None,
        history: History,
        initial: AvatarFields,
        learned_from: Int[np.ndarray, " t"],
        keeper: Keeper | None,
        log: JsonLines | None,
        devices: Devices,
        terms: ExtraTerms | None = None,
        redraw: Redraw | None = None,
    ):
        self.clock = time.perf_counter()
        self.body, self.betas, self.start, self.initial = body, betas, start, initial
        self.config = replace(
            config, points_per_step=min(config.points_per_step, pool.points.shape[1])
        )
        self.deadline = deadline
        self.callback, self.history, self.learned_from = callback, history, learned_from
        self.keeper, self.log, self.devices = keeper, log, devices
        self.redraw = redraw
        self.first = jax.process_index() == 0  # of several hosts, the one that writes

        anchors = devices.replicate(make_anchors(body, jnp.asarray(betas), config))
        # The fields at the start, whose frozen leaves serve every step, where the steps run.
        self.base = devices.replicate(start)
        state, self.steps = make_steps(
            self.base, pool, anchors, self.config, held=held, devices=devices, terms=terms
        )
        self.validation = None
        if held:
            self.validation = make_validation(pool, anchors, self.config, held)
        self.best = Best()
        self.latest: dict[str, Any] = {}
        self.at = 0
        self.validation_s = self.guide_s = 0.0
        saved = None if keeper is None else keeper.saved
        if saved is not None:
            self.best = saved.best(state.learned)
            self.latest.update(saved.latest)
            state, self.at = saved.state(state), saved.step
            # More steps, or other minutes, are another plan.
            if (config.steps, config.minutes) != saved.budget:
                history.planned = history.landing = 0
                state = eqx.tree_at(lambda s: s.fall, state, Fall.create(config.steps))
            self.best = replace(self.best, learned=devices.replicate(self.best.learned))
        self.pace = None
        if deadline is not None and not history.planned and self._falls:
            self.pace = Pace(config.skinning_every if "skinning" in self.steps else 1, deadline)
        self.state, self.pool = devices.replicate(state), devices.replicate(pool)
        self.guide = self._tabulated(state.guide) if has_guide(config) else None
        self.began, self.trained = self.at, history.seconds.get("train", 0.0)
        jax.block_until_ready(self.guide)
        self._book("compile")
        self.compiled: set[str] = set()
        self.unchecked: tuple[int, dict[str, Any]] | None = None
        if redraw is not None:
            redraw.begin(self.at)
        self._write({"event": "start" if saved is None else "resume", **self._head()})

    @cached_property
    def grids(self) -> PartGrids:
        """Where the skinning field is tabulated."""
        return grids_for_search(self.body, self.betas, self.start.skinning, self.config)

    @property
    def guide_moves(self) -> bool:
        """Whether there is a guide, of a field that changes."""
        return self.guide is not None and self.config.skinning.learned

    @property
    def _falls(self) -> bool:
        return self.config.optimiser.schedule == "cosine"

    @property
    def total(self) -> int:
        """Steps that there will be, if nothing ends the run before."""
        return min(self.history.planned or self.config.steps, self.config.steps)

    def to_the_end(self, *, verbose: bool) -> Fitted:
        """Steps until there are enough, time is up, nothing is gained, or somebody stops it."""
        show = verbose and self.first
        with progress("training", self.total, verbose=show, unit="step") as bar:
            bar.update(self.at)
            with stop_between_steps() as flag:
                reason = self._reason(flag)
                while not reason:
                    self._advance()
                    bar.update(1)
                    reason = self._between(flag, bar)
        if self.validation is not None and self.at not in self.history.validated:
            self._validate()
        self._finish(reason)
        return self.fitted()

    def fitted(self) -> Fitted:
        """The best fields so far, or the latest where there are no validation frames."""
        learned = self.state.learned if self.best.learned is None else self.best.learned
        learned = self.devices.collect(jax.tree.map(jnp.copy, learned))
        return Fitted(
            self.initial, eqx.combine(learned, self.start), self.history, self.learned_from
        )

    def _advance(self) -> None:
        """One step. The one before is looked at while this one runs."""
        names, k = list(self.steps), self.at
        # Each kind of step comes once at the start, where bad data shows.
        late = names[-1] if k % self.config.skinning_every == 0 else names[0]
        name = names[k] if k < len(names) else late
        fresh = name not in self.compiled
        if fresh:
            self._book("train")
        k = self.devices.replicate(jnp.asarray(self.at, jnp.int32))
        self.state, terms = self.steps[name](self.state, self.pool, self.guide, k)
        self.at += 1
        previous, self.unchecked = self.unchecked, (self.at, terms)
        self._check(previous)
        self.latest.update(terms)
        if fresh:
            self._settle()
            self.compiled.add(name)
            self._book("compile")

    def _between(self, flag: StopFlag, bar: Any) -> str:
        """What is due after a step; why to stop, if so."""
        config, k = self.config, self.at
        if self.pace is not None:
            self._plan(self.pace, bar)
        polished = "skinning" in self.steps and k % config.polish_every == 0
        guided = self.guide_moves and k % config.search.guide_every == 0
        validated = self.validation is not None and k % config.validation.every == 0
        reported = k % self.config.report_every == 0
        redrawn = 0 if self.redraw is None or k >= config.steps else self.redraw.round_at(k)
        if polished or guided or validated or redrawn:
            self._settle()
        if redrawn:
            self._take_redrawn(redrawn)
        if polished:
            self._polish()
        if guided:
            self._renew_guide()
        if validated:
            self._validate()
        self._land(bar)
        reason = self._reason(flag)
        kept = self.keeper is not None and (bool(reason) or k % config.checkpoint_every == 0)
        if reported or kept or reason:
            self._settle()
            self._report(bar)
        if kept:
            self.history.stopped = reason
            self._save()
        if reason == "interrupt":
            self._interrupt(flag)
        return reason

    def _reason(self, flag: StopFlag) -> str:
        """Why to stop now, or nothing."""
        if self.at >= self.total:
            if self.history.landing:
                return "plateau"
            return "steps" if self.total >= self.config.steps else "minutes"
        if not self._falls and self.best.plateau(self.at, self.config):
            return "plateau"
        # Hosts have clocks and signals of their own: they ask each other, and not at every step.
        if jax.process_count() > 1 and self.at % self.config.report_every:
            return ""
        self._book("train")
        late = self.deadline is not None and time.perf_counter() > self.deadline
        if self.devices.agree(flag.number != 0):
            return "interrupt"
        return "minutes" if self.devices.agree(late) else ""

    def _plan(self, pace: Pace, bar: Any) -> None:
        """Once enough steps were timed: let the schedule end when time does.

        The number is kept, in state, history and checkpoint: a run that goes on has it, too.
        """
        if pace.since is None:
            if len(self.compiled) == len(self.steps) and self.at % pace.cycle == 0:
                self._settle()
                self._book("train")
                if self.validation is not None:
                    self._ask()  # compiles it
                    clock = time.perf_counter()
                    self._ask()
                    self.validation_s = time.perf_counter() - clock
                if self.guide_moves:
                    clock = time.perf_counter()
                    jax.block_until_ready(self._tabulated(self.state.guide))
                    self.guide_s = time.perf_counter() - clock
                self._book("compile")
                pace.start()
            return
        if not pace.enough():
            return
        self._settle()
        extra = self.validation_s / self.config.validation.every
        extra += self.guide_s / max(self.config.search.guide_every, 1)
        end = min(self.at + self.devices.least(pace.steps_left(extra)), self.config.steps)
        self.pace = None
        self._end_at(end, Fall.create(end), "plan", bar)

    def _land(self, bar: Any) -> None:
        """On a plateau, let rates that fall do so within the patience, and end there.

        What they fall through is often worth more than all steps at the rate before it.
        """
        end = self.at + self.config.validation.patience
        if not self._falls or self.history.landing or self.pace is not None or end >= self.total:
            return
        if self.best.plateau(self.at, self.config, self.total):
            self.history.landing = self.at
            fall = Fall.create(end, since=self.at, share=self.at / self.total)
            self._end_at(end, fall, "plateau", bar)

    def _end_at(self, step: int, fall: Fall, event: str, bar: Any) -> None:
        self.history.planned = step
        self.state = eqx.tree_at(lambda s: s.fall, self.state, self.devices.replicate(fall))
        bar.total = self.total
        self._write({"event": event, "step": self.at, "steps": self.total})

    def _ask(self) -> float:
        """The loss on the validation frames."""
        assert self.validation is not None
        fields = eqx.combine(self.state.learned, self.base)
        return float(self.validation(fields, self.pool, self.guide))

    def _polish(self) -> None:
        """Let stored roots follow the skinning field; on one device, for it is little work."""
        config = self.config
        number = self.at // config.polish_every
        rows = rows_in_turn(number, config.polish_frames, len(self.pool.points))
        skinning = self.devices.collect(with_learned(self.base, self.state).skinning)
        table = tabulate_on(skinning, self.grids)
        # Since the last time roots have moved so little that one step leaves micrometres.
        pool = self.devices.collect(self.pool)
        pool = polish_roots(skinning, table, pool, steps=1, rows=rows)
        self.pool = self.devices.replicate(pool)

    def _tabulated(self, learned: Any) -> TabulatedSkinning:
        """The skinning field with these leaves as a guide, on every device."""
        skinning = eqx.combine(self.devices.collect(learned), self.start.skinning)
        return self.devices.replicate(tabulate_on(skinning, self.grids))

    def _renew_guide(self) -> None:
        """Let the guide follow the skinning field, and keep of what: a run that goes on asks."""
        own = jax.tree.map(jnp.copy, self.state.learned.skinning)
        self.state = eqx.tree_at(lambda s: s.guide, self.state, own)
        self._book("train")
        self.guide = jax.block_until_ready(self._tabulated(own))
        self._book("guide")

    def _take_redrawn(self, number: int) -> None:
        """Replace the points of a few frames, and let the next ones be made."""
        assert self.redraw is not None
        self._book("train")
        skinning = self.devices.collect(with_learned(self.base, self.state).skinning)
        new = self.devices.replicate(self.redraw.take(number, skinning))
        self.pool = put_rows(self.pool, new, self.redraw.rows(number))
        self.redraw.begin(self.at)
        self._book("redraw")

    def _validate(self) -> None:
        self._book("train")
        loss = self._ask()
        if not math.isfinite(loss):
            self._fail(self.at, "validation", loss)
        self.best.update(self.at, loss, self.state.learned, self.config.validation)
        self.history.record_validation(self.at, loss)
        self._book("validation")

    def _report(self, bar: Any) -> None:
        """Record the terms, and tell bar, log and callback."""
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
        per_step = self.config.frames_per_step * self.config.points_per_step
        rate = per_step * (k - self.began) / max(used, 1e-9)
        bar.set_postfix(loss=f"{values.get('loss', math.nan):.4f}", points_s=f"{rate:,.0f}")
        self._write({"step": k, "seconds": history.seconds["train"], **values})
        if self.callback is not None and self.first:
            learned = self.devices.collect(jax.tree.map(jnp.copy, self.state.learned))
            self.callback(k, eqx.combine(learned, self.start), values)

    def _save(self) -> None:
        if self.keeper is None or not self.first:
            return
        self._book("train")
        pool = self.pool if self.config.search.cached or self.redraw is not None else None
        self.keeper.save(self.state, self.best, self.history, pool, self.latest)
        self._book("checkpoint")

    def _finish(self, reason: str) -> None:
        history = self.history
        self._book("train")
        history.steps_done, history.stopped = self.at, reason
        history.best_step = self.at if self.best.learned is None else self.best.step
        self._write({"event": "stop", "step": self.at, "reason": reason, "best": history.best_step})

    def _settle(self) -> None:
        """Wait for the latest step and look at it."""
        previous, self.unchecked = self.unchecked, None
        self._check(previous)

    def _check(self, outcome: tuple[int, dict[str, Any]] | None) -> None:
        """Stop if a term is not finite."""
        if outcome is None:
            return
        step, terms = outcome
        values = {name: float(value) for name, value in jax.device_get(terms).items()}
        # The sum and its gradient come last: they are not finite because a term is not.
        for name in sorted(values, key=lambda n: (n.endswith("gradient"), n.endswith("loss"))):
            if not math.isfinite(values[name]):
                self._fail(step, name, values[name])

    def _fail(self, step: int, name: str, value: float) -> NoReturn:
        """Keep the last good state and say which term is to blame."""
        # Neither that step nor the one after it, which has begun, has changed the state.
        self.at = int(self.state.step)
        self.latest = {
            n: v for n, v in ((n, float(v)) for n, v in self.latest.items()) if math.isfinite(v)
        }
        self._finish("not finite")
        self._save()
        where = "as this error's `fitted`"
        if self.keeper is not None:
            where = f"in {self.keeper.path}"
        raise TrainingError(
            f"the {name} term is {value} at step {step}: training has stopped. The state before "
            f"it is kept {where}. Lower the learning rate, or look for a frame whose mesh and "
            "parameters do not belong together.",
            step=step,
            term=name,
            fitted=self.fitted(),
        )

    def _interrupt(self, flag: StopFlag) -> NoReturn:
        """Say what was kept and how to go on."""
        self._finish("interrupt")
        kept = (
            "nothing was saved, since no checkpoint was asked for (checkpoint=FILE); the fields "
            "until here are this error's `fitted`"
        )
        if self.keeper is not None:
            kept = (
                f"the run is kept in {self.keeper.path}; the same call with resume=True goes on "
                "from there"
            )
        raise Interrupted(
            f"stopped at step {self.at} of {self.total}: {kept}.",
            step=self.at,
            signal=flag.number,
            fitted=self.fitted(),
        )

    def _book(self, stage: str) -> None:
        self.clock = self.history.lap(stage, self.clock)

    def _write(self, record: dict[str, Any]) -> None:
        if self.log is not None:
            self.log.write(record)

    def _head(self) -> dict[str, Any]:
        return {
            "step": self.at,
            "version": __version__,
            "jax": jax.__version__,
            "devices": self.devices.count,
            "frames": len(self.learned_from),
            "config": config_to_dict(self.config),
        }
