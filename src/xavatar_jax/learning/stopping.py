"""How training ends early, and what it warns about."""

from __future__ import annotations

import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class TrainingNotice(UserWarning):
    """A training run assumed something, or something about it looks wrong."""


def notify(message: str, record: list[str] | None, *, stacklevel: int) -> None:
    """Warn with a `TrainingNotice`, and add the message to the run's record once."""
    warnings.warn(message, TrainingNotice, stacklevel=stacklevel + 1)
    if record is not None and message not in record:
        record.append(message)


class TrainingError(RuntimeError):
    """Training cannot continue because a loss term is not finite.

    - `step`, `term`: where it happened.
    - `fitted`: the last good state, as the function that was called returns it.
    """

    def __init__(self, message: str, *, step: int = 0, term: str = "", fitted: Any = None):
        super().__init__(message)
        self.step, self.term, self.fitted = step, term, fitted


class Interrupted(KeyboardInterrupt):
    """Training was stopped by Ctrl-C or SIGTERM.

    - `step`: steps done; `signal`: the signal's number; `fitted`: as for `TrainingError`.
    """

    def __init__(self, message: str, *, step: int, signal: int, fitted: Any):
        super().__init__(message)
        self.step, self.signal, self.fitted = step, signal, fitted


class StopFlag:
    """Set by a signal. `number` is the signal's number, or 0."""

    number: int = 0


@contextmanager
def stop_between_steps() -> Iterator[StopFlag]:
    """Inside the block, the first Ctrl-C or SIGTERM only sets the flag; the second acts as usual.

    A step donates its input state, so an exception in the middle of one would leave no state to
    save. Outside the main thread signals do not arrive, and nothing changes.
    """
    flag = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    watched = (signal.SIGINT, signal.SIGTERM)
    former = {number: signal.getsignal(number) for number in watched}

    def note(number: int, frame: FrameType | None) -> None:
        flag.number = number
        restore()

    def restore() -> None:
        for number, handler in former.items():
            # None: a handler that was not set from Python, which cannot be restored.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    for number in watched:
        signal.signal(number, note)
    try:
        yield flag
    finally:
        restore()
