"""Time budgets: how many steps the minutes hold."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import jax

_TIMED_STEPS = 24
_TIMED_SHARE = 0.05  # of the time left: where steps are slow, fewer are timed
_MARGIN = 0.95  # checkpoints and reports take the rest


def check_minutes(minutes: float | None) -> None:
    """**Raises:** `ValueError` for a budget that is not a positive number of minutes."""
    if minutes is not None and not (math.isfinite(minutes) and minutes > 0):
        raise ValueError(f"minutes must be a positive number, found {minutes}")


@dataclass
class Pace:
    """Times steps until the number of steps before the deadline is known.

    `cycle`: steps after which the stages repeat; `deadline`: a time of `time.perf_counter`.
    """

    cycle: int
    deadline: float
    since: float | None = None
    timed: int = 0

    def start(self) -> None:
        """Start timing; everything that the steps use must be compiled by now."""
        self.since, self.timed = time.perf_counter(), 0

    def enough(self) -> bool:
        """Call after each step: whether enough steps were timed.

        With several hosts this depends on the step count alone, so that hosts agree without
        communication.
        """
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
