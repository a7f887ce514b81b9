"""The methods that tables compare: `METHODS[name](frames, minutes, seed)`.

A call learns from frames within so many minutes, counted from it, and gives something that
`xa.evaluate` takes. Fields fitted to the body's mean shape are no part of it: `prepare` makes
those of a method and seed before, and they are kept in the cache folder. They know nothing of the
person.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import xavatar_jax as xa
from xavatar_jax.avatar import Posable
from xavatar_jax.baselines import (
    ScanimateConfig,
    body_only,
    fit_scanimate,
    fit_snarf,
    scanimate_paper,
    scanimate_quick,
    snarf_paper,
    snarf_quick,
    start_fields,
)
from xavatar_jax.body import BodyModel
from xavatar_jax.frames import Frames
from xavatar_jax.training import FitConfig, initial_fields

# Seconds on two cores: a run's compilation, a frame's points and roots, a step of the grids.
_COMPILE_S, _FRAME_S, _STEP_S = 20.0, 0.5, 0.11
_SCAN_S = 0.2  # a frame as SCANimate reads it
_FRAMES_SHARE = 0.4  # of the time, for reading frames
_FEWEST = 12


@dataclass(frozen=True)
class Method:
    """How a method learns, and its config for a budget."""

    learn: Callable[..., Any]
    config: Callable[[float, int], Any]

    def __call__(
        self, frames: Frames, minutes: float, seed: int, *, cache: str | None = None
    ) -> Posable:
        found = self.learn(frames, self.config(minutes, seed), cache=cache, verbose=False)
        return found.avatar if self.learn is xa.fit else found


def for_minutes(config: FitConfig, minutes: float, seed: int) -> FitConfig:
    """As many frames and steps as two cores have time for; the clock ends what takes longer.

    Steps matter where the rate falls with them. A network's rate stays, and it goes on to the end.
    """
    seconds = max(60 * minutes - _COMPILE_S, 10.0)
    frames = _frames(config.train_frames, seconds, _FRAME_S)
    steps = config.steps
    if config.optimiser.schedule == "cosine":
        steps = max(int((seconds - _FRAME_S * frames) / _STEP_S), 50)
    return replace(config, minutes=minutes, seed=seed, train_frames=frames, steps=steps)


def scans_for_minutes(config: ScanimateConfig, minutes: float, seed: int) -> ScanimateConfig:
    """The same for SCANimate, whose stages go by the clock."""
    seconds = max(60 * minutes - _COMPILE_S, 10.0)
    stages = {
        name: replace(stage, steps=10**6) if stage.steps else stage
        for name, stage in (("skin", config.skin), ("cycle", config.cycle), ("shape", config.shape))
    }
    return replace(
        config,
        minutes=minutes,
        seed=seed,
        start=replace(config.start, seed=seed),
        train_frames=_frames(config.train_frames, seconds, _SCAN_S),
        **stages,
    )


def _frames(most: int, seconds: float, each: float) -> int:
    count = max(int(_FRAMES_SHARE * seconds / each), _FEWEST)
    return min(count, most) if most else count


def _template() -> FitConfig:
    config = xa.quick()
    return replace(config, skinning=replace(config.skinning, learned=False))


def _library(learn: Callable[..., Any], preset: Callable[[], FitConfig]) -> Method:
    return Method(learn, lambda minutes, seed: for_minutes(preset(), minutes, seed))


def _scanimate(preset: Callable[[], ScanimateConfig]) -> Method:
    return Method(fit_scanimate, lambda minutes, seed: scans_for_minutes(preset(), minutes, seed))


METHODS: dict[str, Method] = {
    "quick": _library(xa.fit, xa.quick),
    "template weights": _library(xa.fit, _template),
    "paper": _library(xa.fit, xa.paper),
    "SNARF": _library(fit_snarf, snarf_quick),
    "SNARF, paper": _library(fit_snarf, snarf_paper),
    "SCANimate": _scanimate(scanimate_quick),
    "SCANimate, paper": _scanimate(scanimate_paper),
}
"""By the names they have in tables; of the baselines, those without a word are for two cores."""


def prepare(name: str, body: BodyModel, seed: int, *, cache: str | None = None) -> None:
    """Fit a method's fields to the body's mean shape, if the cache folder has none yet."""
    method = METHODS[name]
    config = method.config(1.0, seed)
    if method.learn is xa.fit:
        initial_fields(body, config, cache=cache)
    elif method.learn is fit_snarf:
        initial_fields(body_only(body), config, cache=cache)
    else:
        start_fields(body_only(body), config, cache=cache)
