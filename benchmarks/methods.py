"""The methods that tables compare: `METHODS[name](frames, minutes, seed)`.

A call learns from frames within so many minutes, counted from it, and gives something that
`xa.evaluate` takes. All that a method does is part of them, the fit of its first fields to the
body's mean shape included; but the paper's networks take long to fit, and have theirs from the
cache folder, where `prepare` puts them before.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax

import xavatar_jax as xa
from xavatar_jax.avatar import Avatar, Posable
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

STEPS = 100_000  # more than any budget here holds: minutes decide


@dataclass(frozen=True)
class Method:
    """A function that learns, and its config.

    `prepared`: first fields come from the cache folder, and are no part of the minutes.
    """

    learn: Callable[..., Any]
    preset: Callable[[], Any]
    prepared: bool = False

    def __call__(
        self,
        frames: Frames,
        minutes: float,
        seed: int,
        *,
        small: bool = False,
        cache: str | None = None,
    ) -> Posable:
        config = self.config(minutes, seed, small)
        if self.prepared:
            found = self.learn(frames, config, cache=cache, verbose=False)
        else:
            with tempfile.TemporaryDirectory() as empty:
                found = self.learn(frames, config, cache=empty, verbose=False)
        return found.avatar if self.learn is xa.fit else found

    def config(self, minutes: float, seed: int, small: bool) -> Any:
        """The preset, with what time alone allows; `small`, with a few frames and steps."""
        config = self.preset()
        if isinstance(config, ScanimateConfig):
            stages = {name: getattr(config, name) for name in ("skin", "cycle", "shape")}
            return replace(
                config,
                seed=seed,
                minutes=None if small else minutes,
                train_frames=3 if small else 0,
                start=_configured(config.start, minutes, seed, small),
                **{
                    name: replace(stage, steps=min(stage.steps, 60) if small else STEPS)
                    for name, stage in stages.items()
                    if stage.steps
                },
            )
        return _configured(config, minutes, seed, small)


def _configured(config: FitConfig, minutes: float, seed: int, small: bool) -> FitConfig:
    if small:
        return replace(config, seed=seed, steps=6, train_frames=3, prefit_steps=60)
    return replace(config, seed=seed, steps=STEPS, minutes=minutes, train_frames=0)


def _template_weights() -> FitConfig:
    config = xa.quick()
    return replace(config, skinning=replace(config.skinning, learned=False))


METHODS: dict[str, Method] = {
    "quick": Method(xa.fit, xa.quick),
    "template weights": Method(xa.fit, _template_weights),
    "SNARF": Method(fit_snarf, snarf_quick),
    "SCANimate": Method(fit_scanimate, scanimate_quick),
    "paper": Method(xa.fit, xa.paper, prepared=True),
    "SNARF, paper": Method(fit_snarf, snarf_paper, prepared=True),
    "SCANimate, paper": Method(fit_scanimate, scanimate_paper, prepared=True),
}
"""By the names they have in tables. Baselines without a word are in their size for two cores."""


def learn(
    name: str,
    capture: Any,
    minutes: float,
    seed: int,
    *,
    small: bool = False,
    cache: str | None = None,
) -> tuple[Posable, dict[str, float]]:
    """What a method gives, with its seconds and steps; nothing is compiled when it begins."""
    prepare(name, capture.body, seed, small=small, cache=cache)
    jax.clear_caches()
    clock = time.perf_counter()
    model: Any = METHODS[name](capture.train, minutes, seed, small=small, cache=cache)
    spent = time.perf_counter() - clock
    steps = model.steps if isinstance(model, Avatar) else model.avatar.steps
    return model, {"fit_s": spent, "steps": steps}


def prepare(
    name: str, body: BodyModel, seed: int, *, small: bool = False, cache: str | None = None
) -> None:
    """Fit a method's first fields into the cache folder, if they are to come from there."""
    method = METHODS[name]
    if not method.prepared:
        return
    config = method.config(1.0, seed, small)
    if method.learn is xa.fit:
        initial_fields(body, config, cache=cache)
    elif method.learn is fit_snarf:
        initial_fields(body_only(body), config, cache=cache)
    else:
        start_fields(body_only(body), config, cache=cache)
