"""The record of a run: its history, its log file and its progress bar."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..files import atomic_path

_LINE_EVERY_S = 10.0


@dataclass
class History:
    """Losses by step, seconds by activity, and how the run ended.

    - `steps`, `terms`: the steps at which terms were recorded, and the values of each term.
    - `validated`, `validation`: the steps at which validation ran, and its losses.
    - `seconds`: by activity, summed over all calls of a resumed run; `total` is of the last call.
    - `steps_done`; `best_step`: the step whose model is kept; `stopped`: "steps", "minutes",
      "plateau", "interrupt" or "not finite".
    - `frames`: how many frames were learned from; `planned`: how many steps the minutes were
      found to hold (0: not planned); `landing`: the step at which a plateau moved the end nearer
      (0: none did).
    - `found`: the share of points with a root, where roots are stored.
    - `notices`: warnings about the frames or the checkpoint.
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

    def lap(self, activity: str, since: float) -> float:
        """Add the time since `since` to an activity; returns the current time."""
        now = time.perf_counter()
        self.seconds[activity] = self.seconds.get(activity, 0.0) + now - since
        return now

    def record(self, step: int, terms: Mapping[str, float]) -> None:
        """Add the terms of a step. A term that is missing at a step is NaN there."""
        self.steps.append(step)
        for name in {**self.terms, **terms}:
            values = self.terms.setdefault(name, [float("nan")] * (len(self.steps) - 1))
            values.append(terms.get(name, float("nan")))

    def append(self, other: History) -> None:
        """Add a run that followed this one: its steps are counted from the end of this one."""
        before = self.steps_done
        for k, step in enumerate(other.steps):
            self.record(before + step, {name: values[k] for name, values in other.terms.items()})
        for activity, seconds in other.seconds.items():
            self.seconds[activity] = self.seconds.get(activity, 0.0) + seconds
        self.steps_done = self.best_step = before + other.steps_done
        self.stopped = other.stopped
        self.notices += [said for said in other.notices if said not in self.notices]

    def to_dict(self) -> dict[str, Any]:
        """Plain values; `History(**values)` reads them back."""
        return asdict(self)


class JsonLines:
    """A log file of one JSON object a line, flushed line by line.

    With `after`, an existing file is continued: records of later steps are dropped, because a
    resumed run writes them again. Otherwise an existing file is replaced.
    """

    def __init__(self, path: str | os.PathLike[str], *, after: int | None = None):
        self._path = Path(path)
        kept: list[dict[str, Any]] = []
        if after is not None and self._path.exists():
            kept = [line for line in read_log(self._path) if line.get("step", 0) <= after]
        with atomic_path(self._path) as temporary:
            temporary.write_text("".join(_line(record) for record in kept), encoding="utf-8")

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one record."""
        with open(self._path, "a", encoding="utf-8") as file:
            file.write(_line(record))


def read_log(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The records of a log. An incomplete last line is left out.

    **Raises:** `ValueError` naming file and line for any other line that is not JSON.
    """
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    records = []
    for number, line in enumerate(lines, 1):
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number == len(lines):
                break
            raise ValueError(f"{os.fspath(path)}, line {number}: not JSON ({error})") from error
    return records


def _line(record: Mapping[str, Any]) -> str:
    """One line of JSON; values that are not finite become null."""
    plain = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in record.items()
    }
    return json.dumps(plain, allow_nan=False) + "\n"


def progress(what: str, total: int | None, *, verbose: bool, unit: str = "it") -> Any:
    """A tqdm bar with an ETA in a terminal or notebook; elsewhere a line every ten seconds."""
    from tqdm.auto import tqdm

    if verbose and not sys.stderr.isatty() and "ipykernel" not in sys.modules:
        return _ProgressLines(what, total, unit)
    return tqdm(total=total, desc=what, unit=unit, disable=not verbose, dynamic_ncols=True)


class _ProgressLines:
    """The part of a tqdm bar that we use, for output that is not a terminal."""

    def __init__(self, what: str, total: int | None, unit: str):
        self.what, self.total, self.unit = what, total, unit
        self.n = self.counted = 0  # so far, and in the last line
        self.postfix = ""
        self.began = self.shown = time.perf_counter()

    def __enter__(self) -> _ProgressLines:
        return self

    def __exit__(self, *error: object) -> None:
        if self.shown > self.began and self.n > self.counted:
            self._show(time.perf_counter())

    def set_postfix(self, **values: str) -> None:
        """Values to show at the end of the next line."""
        self.postfix = "".join(f", {name}={value}" for name, value in values.items())

    def update(self, n: int) -> None:
        """Count `n` more, and print a line if ten seconds have passed since the last one."""
        self.n += n
        now = time.perf_counter()
        if now - self.shown >= _LINE_EVERY_S:
            self._show(now)

    def _show(self, now: float) -> None:
        self.shown, self.counted, spent = now, self.n, now - self.began
        left = ""
        if self.total and 0 < self.n < self.total:
            left = f", {spent / self.n * (self.total - self.n):.0f} s left"
        of = f"/{self.total}" if self.total else ""
        line = f"{self.what}: {self.n}{of} {self.unit}s, {spent:.0f} s{left}{self.postfix}"
        print(line, file=sys.stderr, flush=True)
