"""How a command ends: exit codes, one clear line for an error, notices, signals."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

FAILED, BAD_INPUT = 1, 2
# What a path or a file that was named can be at fault for; other OSErrors are the machine's.
_BAD_PATHS = (
    FileNotFoundError,
    FileExistsError,
    IsADirectoryError,
    NotADirectoryError,
    PermissionError,
)


class Terminated(KeyboardInterrupt):
    """SIGTERM, as batch systems send it: ends a command as Ctrl-C does."""

    signal = signal.SIGTERM


def exit_code(
    run: Callable[[], None], *, spoken: Mapping[str, str] | None = None, debug: bool = False
) -> int:
    """Run a command; errors become one message on stderr and an exit code.

    `spoken` says how arguments of the library that messages name are called on the command line.
    `debug` lets errors pass, with their traceback.
    """
    spoken = spoken or {}
    try:
        with _sigterm_raises():
            run()
            sys.stdout.flush()
        return 0
    except SystemExit as end:  # tyro's, after it has printed help or what is wrong
        return end.code if isinstance(end.code, int) else FAILED
    except KeyboardInterrupt as stop:
        # What training raises says more; its state has been saved.
        again = " On the command line that is: the same command with --resume."
        _say(
            f"\n{stop}{again}" if hasattr(stop, "fitted") else "\nstopped: nothing is half-written."
        )
        return 128 + getattr(stop, "signal", signal.SIGINT)
    except BrokenPipeError:
        # The reader of our output, `head` say, has left: nobody is there to be told.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        if debug:
            raise
        text, code = describe(error)
        _say(f"error: {in_options(text, spoken)}")
        return code


def describe(error: Exception) -> tuple[str, int]:
    """What to say of an error, and the exit code."""
    from ..meshing import EmptyLevelSetError
    from ..training import TrainingError

    text = str(error)
    if isinstance(error, OSError):
        if error.strerror:  # raised by the system; our own have a sentence
            text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
        return text, BAD_INPUT if isinstance(error, _BAD_PATHS) else FAILED
    if isinstance(error, EmptyLevelSetError | TrainingError):
        return text, FAILED
    if isinstance(error, ValueError):
        return text, BAD_INPUT
    if isinstance(error, MemoryError):
        return f"out of memory. {text}".strip(), FAILED
    where = "; the same command with --debug shows where"
    return f"{type(error).__name__}: {text or 'no message'}{where}", FAILED


def in_options(message: str, spoken: Mapping[str, str]) -> str:
    """The message, with the command line's names of the arguments that it asks for."""
    named = dict.fromkeys(re.findall(r"\b([a-z_]+)=", message))
    options = [spoken[name] for name in named if name in spoken]
    return f"{message} (On the command line: {', '.join(options)}.)" if options else message


@contextmanager
def notices_as_lines(spoken: Mapping[str, str]) -> Iterator[None]:
    """Notices of the library as one line each on stderr, none twice; other warnings as ever."""
    from ..datasets.capture import CaptureNotice
    from ..motion import MotionNotice
    from ..training import TrainingNotice

    notices, said = (CaptureNotice, MotionNotice, TrainingNotice), set()
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message, category, filename, lineno, file=None, line=None):
            if not issubclass(category, notices):
                usual(message, category, filename, lineno, file, line)
            elif str(message) not in said:
                said.add(str(message))
                _say(f"notice: {in_options(str(message), spoken)}")

        for notice in notices:
            warnings.simplefilter("always", notice)
        warnings.showwarning = show
        yield


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """SIGTERM ends a command as Ctrl-C does, so that temporary files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise Terminated

    former = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if former is None else former)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
