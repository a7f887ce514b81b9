"""The loop: frames to a pool, a pool to fields."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..body import BodyModel, check_params
from ..frames import Frames
from ..sampling import varied_frames
from .config import FitConfig
from .model import AvatarFields, settle_on_person
from .objective import make_anchors
from .pool import FramePool, find_roots, label_frames, polish_roots, tabulate_for_search
from .prefit import initial_fields
from .progress import progress
from .step import make_steps, with_learned


class TrainingError(RuntimeError):
    """Training cannot go on: a term of the loss is not finite."""


@dataclass
class History:
    """What happened: losses by step, seconds by stage, steps a second and points a second."""

    steps: list[int] = field(default_factory=list)
    terms: dict[str, list[float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    steps_done: int = 0
    found: float = float("nan")

    def lap(self, stage: str, since: float) -> float:
        """Book the time since `since` on a stage; returns now."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        return now

    def record(self, step: int, terms: dict[str, float]) -> None:
        self.steps.append(step)
        for name, value in terms.items():
            self.terms.setdefault(name, []).append(value)


@dataclass(frozen=True)
class Fitted:
    """Fields at step 0 and at the end, and the way between."""

    initial: AvatarFields
    fields: AvatarFields
    history: History


def fit_fields(
    body: BodyModel,
    frames: Frames,
    betas: Any,
    config: FitConfig,
    *,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
    callback: Callable[[int, AvatarFields, dict[str, float]], None] | None = None,
) -> Fitted:
    """Learn fields from frames. `callback(step, fields, terms)` is called now and then.

    **Raises:** `ValueError` for frames that do not fit the body; `TrainingError` naming the term
    that is not finite.
    """
    started = time.perf_counter()
    check_params(body, frames.params, what="frames.params")
    history = History()

    initial = initial_fields(body, config, cache=cache, verbose=verbose)
    clock = history.lap("prefit", started)
    start = settle_on_person(body, initial, betas, config)
    clock = history.lap("settle", clock)
    count = config.train_frames or len(frames)
    chosen = frames[varied_frames(frames.params, count)]
    with progress("points", len(chosen), verbose=verbose, unit="frame") as bar:
        pool = label_frames(body, chosen, config, bar=bar)
    clock = history.lap("labels", clock)
    if config.search.cached:
        with progress("roots", len(chosen), verbose=verbose, unit="frame") as bar:
            pool = find_roots(body, betas, start.skinning, pool, config, bar=bar)
        history.found = float(pool.found.mean() / pool.points.shape[1])
        clock = history.lap("roots", clock)
    fitted = train_pool(
        body,
        start,
        pool,
        betas,
        config,
        seconds=_left(config, started),
        verbose=verbose,
        callback=callback,
        history=history,
        initial=initial,
    )
    history.lap("total", started)
    return fitted


def train_pool(
    body: BodyModel,
    start: AvatarFields,
    pool: FramePool,
    betas: Any,
    config: FitConfig,
    *,
    seconds: float | None = None,
    verbose: bool = True,
    callback: Callable[[int, AvatarFields, dict[str, float]], None] | None = None,
    history: History | None = None,
    initial: AvatarFields | None = None,
    report_every: int = 25,
) -> Fitted:
    """Train fields on points that are labelled already, for `config.steps` or `seconds`.

    The seconds count from the first step after compilation. Every `report_every` steps the terms
    are checked and recorded, and `callback` is called. `start` is what training begins
    from; `initial`, if it differs, what the result calls its step 0.
    """
    history = History() if history is None else history
    clock = time.perf_counter()
    anchors = make_anchors(body, jnp.asarray(betas), config)
    config = replace(config, points_per_step=min(config.points_per_step, pool.points.shape[1]))
    state, steps = make_steps(start, pool, anchors, config)
    names = list(steps)
    latest: dict[str, Any] = {}
    for name in names:
        state, terms = jax.block_until_ready(steps[name](state, pool))
        # The first steps show bad data while the fields are still good: the term named is to blame.
        _check_finite({term: float(value) for term, value in terms.items()}, 1)
        latest.update(terms)
    clock = history.lap("compile", clock)
    per_step = config.frames_per_step * config.points_per_step
    with progress("training", config.steps, verbose=verbose, unit="step") as bar:
        k = len(names)
        bar.update(k)
        while k < config.steps:
            name = names[-1] if k % config.skinning_every == 0 else names[0]
            state, terms = steps[name](state, pool)
            latest.update(terms)
            k += 1
            bar.update(1)
            if "skinning" in steps and k % config.polish_every == 0:
                skinning = with_learned(start, state).skinning
                pool = polish_roots(
                    skinning, tabulate_for_search(body, betas, skinning, config), pool
                )
            if k % report_every and k != config.steps:
                continue
            values = {name: float(value) for name, value in latest.items()}
            _check_finite(values, k)
            history.record(k, values)
            rate = per_step * (k - len(names)) / max(time.perf_counter() - clock, 1e-9)
            bar.set_postfix(loss=f"{values['loss']:.4f}", points_s=f"{rate:,.0f}")
            if callback is not None:
                callback(k, with_learned(start, state), values)
            if seconds is not None and time.perf_counter() - clock > seconds:
                break
    history.steps_done = k
    jax.block_until_ready(state.learned)
    history.lap("train", clock)
    return Fitted(start if initial is None else initial, with_learned(start, state), history)


def _left(config: FitConfig, started: float) -> float | None:
    """Seconds of the budget that are left, compilation of the step included."""
    if config.minutes is None:
        return None
    return max(60 * config.minutes - (time.perf_counter() - started), 0.0)


def subject_betas(frames: Frames) -> np.ndarray:
    """The one shape of the person: the mean of the frames' betas."""
    return np.asarray(frames.params.betas).mean(0)


def _check_finite(values: dict[str, float], step: int) -> None:
    # The sum comes last: it is not finite because one of its terms is not.
    for name in sorted(values, key=lambda n: n.endswith("loss")):
        value = values[name]
        if not np.isfinite(value):
            raise TrainingError(
                f"the {name} term is {value} at step {step}: training has stopped. Lower the "
                "learning rate, or look for a frame whose mesh and parameters do not belong "
                "together."
            )
