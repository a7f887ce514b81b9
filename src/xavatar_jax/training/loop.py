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
from .pool import find_roots, label_frames, polish_roots, tabulate_for_search
from .prefit import initial_fields
from .progress import progress
from .step import make_steps, with_learned

_REPORT_EVERY = 25


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

    def lap(stage: str, since: float) -> float:
        now = time.perf_counter()
        history.seconds[stage] = history.seconds.get(stage, 0.0) + now - since
        return now

    initial = initial_fields(body, config, cache=cache, verbose=verbose)
    clock = lap("prefit", started)
    start = settle_on_person(body, initial, betas, config)
    clock = lap("settle", clock)
    count = config.train_frames or len(frames)
    chosen = frames[varied_frames(frames.params, count)]
    with progress("points", len(chosen), verbose=verbose, unit="frame") as bar:
        pool = label_frames(body, chosen, config, bar=bar)
    clock = lap("labels", clock)
    if config.search.cached:
        with progress("roots", len(chosen), verbose=verbose, unit="frame") as bar:
            pool = find_roots(body, start.skinning, pool, config, bar=bar)
        history.found = float(pool.found.mean() / pool.points.shape[1])
        clock = lap("roots", clock)
    anchors = make_anchors(body, jnp.asarray(betas), config)
    config = replace(config, points_per_step=min(config.points_per_step, pool.points.shape[1]))
    state, steps = make_steps(start, pool, anchors, config)
    names = list(steps)
    latest: dict[str, Any] = {}
    for name in names:
        state, terms = jax.block_until_ready(steps[name](state, pool))
        latest.update(terms)
    clock = lap("compile", clock)
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
                fields = with_learned(start, state)
                table = tabulate_for_search(body, fields.skinning, config)
                pool = polish_roots(fields.skinning, table, pool)
            if k % _REPORT_EVERY == 0 or k == config.steps:
                values = {name: float(value) for name, value in latest.items()}
                _check_finite(values, k)
                history.record(k, values)
                rate = per_step * (k - 1) / max(time.perf_counter() - clock, 1e-9)
                bar.set_postfix(loss=f"{values['loss']:.4f}", points_s=f"{rate:,.0f}")
                if callback is not None:
                    callback(k, with_learned(start, state), values)
                if config.minutes and time.perf_counter() - started > 60 * config.minutes:
                    break
    history.steps_done = k
    lap("train", clock)
    history.seconds["total"] = time.perf_counter() - started
    return Fitted(initial, with_learned(start, state), history)


def subject_betas(frames: Frames) -> np.ndarray:
    """The one shape of the person: the mean of the frames' betas."""
    return np.asarray(frames.params.betas).mean(0)


def _check_finite(values: dict[str, float], step: int) -> None:
    for name, value in values.items():
        if not np.isfinite(value):
            raise TrainingError(
                f"the {name} term is {value} at step {step}: training has stopped. Lower the "
                "learning rate, or look for a frame whose mesh and parameters do not belong together."
            )
