"""What happened in a run."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass
class History:
    """Losses by step, seconds by stage, and how the run ended.

    - `steps`, `terms`: steps at which terms were recorded, and each term there.
    - `validated`, `validation`: steps at which validation frames were asked, and their loss.
    - `seconds`: by stage, over all calls where a run was resumed; `total` is of the last call.
    - `steps_done`; `best_step`: the step whose fields are kept; `stopped`: "steps", "minutes",
      "plateau", "interrupt" or "not finite".
    - `frames`: how many were learned from; `planned`: steps that the minutes were found to hold,
      where the schedule falls (0: not planned); `landing`: the step at which a plateau brought
      the end nearer (0: none did).
    - `found`: share of points with a root, where roots are stored.
    - `notices`: what was said of the frames or the checkpoint.
    """

    steps: list[int] = field(default_factory=list)
    terms: dict[str, list[float]] = field(default_factory=dict)
    validated: list[int] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    steps_done: int = 0
    best_step: int = 0
    stopped: str = ""
    frames: int = 0
    planned: int = 0
    landing: int = 0
    found: float = float("nan")
    notices: list[str] = field(default_factory=list)

    def lap(self, stage: str, since: float) -> float:
        """Book the time since `since` on a stage; returns now."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        return now

    def record(self, step: int, terms: Mapping[str, float]) -> None:
        """Add terms at a step; a term that is not there now, or was not before, is NaN."""
        self.steps.append(step)
        for name in {**self.terms, **terms}:
            values = self.terms.setdefault(name, [float("nan")] * (len(self.steps) - 1))
            values.append(terms.get(name, float("nan")))

    def record_validation(self, step: int, loss: float) -> None:
        """Add a validation loss at a step."""
        self.validated.append(step)
        self.validation.append(loss)

    def to_dict(self) -> dict[str, Any]:
        """Plain values; `History(**values)` reads them back."""
        return asdict(self)
