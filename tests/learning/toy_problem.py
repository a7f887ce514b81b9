"""A line fitted to points by two stages: a problem for the loop that needs no body."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from xavatar_jax.learning import (
    FALLING,
    ONE_DEVICE,
    History,
    Identity,
    JsonLines,
    Keeper,
    Schedule,
    Stage,
    Validation,
    load_checkpoint,
    train,
)


class Line(eqx.Module):
    """`y = slope · x + offset + fixed`."""

    slope: jax.Array
    offset: jax.Array
    fixed: jax.Array

    def __call__(self, x):
        return x @ self.slope + self.offset + self.fixed


class Points(eqx.Module):
    x: jax.Array
    y: jax.Array


class DrawRows(eqx.Module):
    """Random rows, but none of the last `held`."""

    count: int = eqx.field(static=True)
    held: int = eqx.field(static=True, default=0)

    def __call__(self, model, data, key):
        rows = jax.random.randint(key, (self.count,), 0, len(data.x) - self.held)
        return Points(data.x[rows], data.y[rows])


class WholeData(eqx.Module):
    def __call__(self, model, data, key):
        return data


class SquaredError(eqx.Module):
    def __call__(self, model, batch, key):
        return ((model(batch.x) - batch.y) ** 2).mean()


class Learns(eqx.Module):
    """Marks the named leaves."""

    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, model):
        nothing = jax.tree.map(lambda _: False, model)
        return eqx.tree_at(
            lambda m: [getattr(m, name) for name in self.names], nothing, [True] * len(self.names)
        )


class HeldError(eqx.Module):
    """The error on the last `held` points."""

    held: int = eqx.field(static=True)

    def __call__(self, model, data):
        return ((model(data.x[-self.held :]) - data.y[-self.held :]) ** 2).mean()


ADAM, SGD = optax.adam(0.05), optax.sgd(0.1)


def line() -> Line:
    return Line(jnp.zeros(3), jnp.zeros(()), jnp.asarray(0.25))


def points(count: int = 40) -> Points:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(count, 3))
    y = x @ [1.0, -2.0, 0.5] + 0.7 + 0.1 * rng.normal(size=count)
    return Points(jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32))


def stage(name: str = "slope", learns: tuple[str, ...] = ("slope",), **changes: Any) -> Stage:
    given = {
        "draw": DrawRows(8),
        "terms": {"error": (1.0, SquaredError())},
        "optimiser": ADAM,
        "learns": Learns(learns),
    }
    return Stage(name, **{**given, **changes})


def two_stages(every: int = 4, **changes: Any) -> tuple[Stage, Stage]:
    """The slope's, and every so many steps the offset's, which falls too."""
    draw = DrawRows(8, held=10)
    return (
        stage(draw=draw, schedule=FALLING, **changes),
        stage("offset", ("offset",), draw=draw, schedule=FALLING, every=every, prefix="offset_",
              **changes),
    )  # fmt: skip


@dataclass(frozen=True)
class Turn:
    """Upkeep that turns the order of the points: later draws depend on how often it was called."""

    every: int = 5
    name: str = "turn"
    repeatable: bool = True

    def __call__(self, model, data, step):
        return Points(jnp.roll(data.x, step, axis=0), jnp.roll(data.y, step))


@dataclass(frozen=True)
class Spoil:
    """Upkeep that makes the points unusable once, after a step."""

    every: int
    name: str = "spoil"
    repeatable: bool = False

    def __call__(self, model, data, step):
        return Points(data.x, data.y * jnp.nan)


OPTIONS = {"steps": 12, "rates": {"slope": 0.05, "offset": 0.05}}


def identity(**parts: str) -> Identity:
    return Identity({"points": "3f", **parts}, OPTIONS, free=("steps",))


def run(
    path: Path | None = None,
    *,
    resume: bool = False,
    steps: int = 12,
    upkeep: tuple[Any, ...] = (Turn(),),
    every: int = 4,
    log: Path | None = None,
    callback: Any = None,
    kept: bool = True,
    validation: Validation | None = Validation(HeldError(10), every=3),  # noqa: B008
    **schedule: Any,
) -> Any:
    """Both stages with upkeep, validation and, with a path, checkpoints every four steps."""
    keeper, history = None, History()
    if path is not None:
        saved = load_checkpoint(path, identity(), ONE_DEVICE) if resume else None
        more = {"kept": lambda data: data} if kept else {}
        keeper = Keeper(path, identity(), saved, **more)
        history = history if saved is None else saved.history()
    data = points()
    if keeper is not None and keeper.saved is not None and kept:
        data = Points(**{n: jnp.asarray(v) for n, v in keeper.saved.part("data").items()})
    lines = None if log is None else JsonLines(log, after=history.steps_done or None)
    schedule = {"report_every": 2, "checkpoint_every": 4, **schedule}
    return train(
        line(), data, two_stages(every), Schedule(steps, **schedule),
        upkeep=upkeep, validation=validation, history=history, keeper=keeper, log=lines,
        callback=callback, verbose=False,
    )  # fmt: skip


def interrupt_at(step: int) -> Any:
    """A callback that sends the signal of Ctrl-C."""

    def callback(k, model, terms):
        if k == step:
            os.kill(os.getpid(), signal.SIGINT)

    return callback


def same(a: Any, b: Any) -> bool:
    """Whether all leaves are equal, bit for bit."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)
