"""A budget of minutes: how many frames it can label, and how many steps it holds."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import jax

from ..files import load_header
from .check import notify
from .config import FitConfig

_LEAST_FRAMES = 24
_TIMED_STEPS = 24
_TIMED_SHARE = 0.05  # of what is left: where steps are slow, fewer are timed
_MARGIN = 0.95  # polishing and checkpoints come out of the rest


class Budget(Protocol):
    """What a config says of frames and time: see `FitConfig`."""

    @property
    def minutes(self) -> float | None: ...
    @property
    def train_frames(self) -> int: ...
    @property
    def frames_per_minute(self) -> int: ...


def check_minutes(minutes: float | None) -> None:
    """**Raises:** `ValueError` for a budget that is not a positive number of minutes."""
    if minutes is not None and not (math.isfinite(minutes) and minutes > 0):
        raise ValueError(f"minutes must be a positive number, found {minutes}")


def frames_in_budget(config: Budget) -> int:
    """How many frames to learn from (0: all): `train_frames`, or what `minutes` can label.

    The first minute is for what any run begins with: first fields, compilation, steps. Told by
    the config alone, so that no draw depends on a clock.
    """
    if config.minutes is None or not config.frames_per_minute:
        return config.train_frames
    most = max(round((config.minutes - 1) * config.frames_per_minute), _LEAST_FRAMES)
    return min(config.train_frames, most) if config.train_frames else most


def say_fewer_frames(
    config: FitConfig, learned: int, wanted: int, record: list[str] | None
) -> None:
    """Say (see `notify`) if the budget left frames out."""
    if learned < wanted:
        notify(
            f"{learned} of {wanted} frames are learned from: {config.minutes:g} minutes would "
            f"go into labelling the others (frames_per_minute={config.frames_per_minute}; 0 takes "
            "them all).",
            record,
            stacklevel=5,
        )


def as_begun(config: FitConfig, checkpoint: str | os.PathLike[str]) -> FitConfig:
    """The config with as many frames as the run of a checkpoint began with, if there is one.

    A run that goes on has the same frames, whatever its minutes are now.
    """
    if not Path(checkpoint).exists():
        return config
    frames = load_header(checkpoint).get("history", {}).get("frames", 0)
    return replace(config, minutes=None, train_frames=frames) if frames else config


@dataclass
class Pace:
    """Times steps until it is known how many the time until `deadline` holds.

    `cycle`: steps after which kinds of steps repeat; `deadline`: of `time.perf_counter`.
    """

    cycle: int
    deadline: float
    since: float | None = None
    timed: int = 0

    def start(self) -> None:
        """Count from now; what is compiled at first use must be compiled."""
        self.since, self.timed = time.perf_counter(), 0

    def enough(self) -> bool:
        """After a step: whether enough were timed. Hosts agree on this without a word."""
        if self.since is None:
            return False
        self.timed += 1
        if self.timed % self.cycle:
            return False
        if self.timed >= _TIMED_STEPS or jax.process_count() > 1:
            return self.timed >= _TIMED_STEPS
        now = time.perf_counter()
        return now - self.since > _TIMED_SHARE * (self.deadline - self.since)

    def steps_left(self, extra: float) -> int:
        """How many more steps there is time for, each with `extra` seconds of other work."""
        assert self.since is not None
        now = time.perf_counter()
        each = (now - self.since) / self.timed + extra
        return max(int(_MARGIN * (self.deadline - now) / each), 1)
