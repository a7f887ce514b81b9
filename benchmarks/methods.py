"""The methods compared in the tables: `METHODS[name](frames, minutes, seed)`.

A call trains for a number of minutes since the call and returns an object for `xa.evaluate`. The
time includes everything, also the fit of the first fields to the body's mean shape. The paper's
networks are an exception: their fit takes long, so `prepare` stores it in the cache folder first.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from search_problems import mean_shape_model

import xavatar_jax as xa
from xavatar_jax.avatar import Avatar, Drivable, body_only
from xavatar_jax.body import BodyModel
from xavatar_jax.frames import Frames
from xavatar_jax.methods import (
    fit_scanimate,
    fit_snarf,
    scanimate_paper,
    scanimate_quick,
    snarf_paper,
    snarf_quick,
)
from xavatar_jax.methods.scanimate import ScanimateConfig
from xavatar_jax.methods.scanimate.fit import start_model
from xavatar_jax.methods.xavatar import FitConfig

STEPS = 100_000  # more than any time limit here allows


@dataclass(frozen=True)
class Method:
    """A training function and its preset.

    `prepared`: first fields come from the cache folder and are not part of the minutes.
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
    ) -> Drivable:
        config = self.config(minutes, seed, small)
        if self.prepared:
            found = self.learn(frames, config, cache=cache, verbose=False)
        else:
            with tempfile.TemporaryDirectory() as empty:
                found = self.learn(frames, config, cache=empty, verbose=False)
        return found.avatar

    def config(self, minutes: float, seed: int, small: bool) -> Any:
        """The preset, limited by time only, or by few frames and steps if `small`."""
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
    return replace(config, learn_skinning=False)


METHODS: dict[str, Method] = {
    "quick": Method(xa.fit, xa.quick),
    "template weights": Method(xa.fit, _template_weights),
    "SNARF": Method(fit_snarf, snarf_quick),
    "SCANimate": Method(fit_scanimate, scanimate_quick),
    "paper": Method(xa.fit, xa.paper, prepared=True),
    "SNARF, paper": Method(fit_snarf, snarf_paper, prepared=True),
    "SCANimate, paper": Method(fit_scanimate, scanimate_paper, prepared=True),
}
"""Methods by their names in tables. Baselines not named "paper" are sized for two cores."""


def learn(
    name: str,
    capture: Any,
    minutes: float,
    seed: int,
    *,
    small: bool = False,
    cache: str | None = None,
) -> tuple[Drivable, dict[str, float]]:
    """Train a method without compiled programs; returns the model, its seconds and steps."""
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
    """Store a method's first fields in the cache folder, if it is `prepared`."""
    method = METHODS[name]
    if not method.prepared:
        return
    config = method.config(1.0, seed, small)
    if method.learn is xa.fit:
        mean_shape_model(body, config, cache=cache)
    elif method.learn is fit_snarf:
        mean_shape_model(body_only(body), config, cache=cache)
    else:
        cut = body_only(body)
        start_model(cut, np.zeros(cut.num_betas), config, cache=cache)
