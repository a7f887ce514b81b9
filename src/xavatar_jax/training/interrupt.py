"""Ctrl-C between steps, not within one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class StopFlag:
    """Set by a signal; `number` is which one, 0 for none."""

    number: int = 0


@contextmanager
def stop_between_steps() -> Iterator[StopFlag]:
    """While the block runs, the first Ctrl-C or SIGTERM only sets the flag; the second acts.

    A step gives its input's memory away, so that an exception in its midst would leave no state
    to save. Outside of the main thread signals do not arrive, and nothing is changed.
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
            # None: a handler that was not set from Python, which cannot be set back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    for number in watched:
        signal.signal(number, note)
    try:
        yield flag
    finally:
        restore()
