"""How training can end early."""

from __future__ import annotations

from typing import Any


class TrainingError(RuntimeError):
    """Training cannot go on: a term of the loss is not finite.

    - `step`, `term`: which one, and when.
    - `fitted`: the fields of the last good state, and the history until then.
    """

    def __init__(self, message: str, *, step: int = 0, term: str = "", fitted: Any = None):
        super().__init__(message)
        self.step, self.term, self.fitted = step, term, fitted


class Interrupted(KeyboardInterrupt):
    """Training was stopped from outside, by Ctrl-C or SIGTERM, and its state is saved if asked.

    - `step`: steps done; `signal`: the signal's number; `fitted`: as for `TrainingError`.
    """

    def __init__(self, message: str, *, step: int, signal: int, fitted: Any):
        super().__init__(message)
        self.step, self.signal, self.fitted = step, signal, fitted
