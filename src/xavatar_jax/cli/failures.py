"""Exit codes, error messages, notices and signals of a command."""

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
# Errors of a path given by the user; every other OSError is a failure of the machine.
_BAD_PATHS = (
    *(FileNotFoundError, FileExistsError, IsADirectoryError),
    *(NotADirectoryError, PermissionError),
)


class Terminated(KeyboardInterrupt):
    """SIGTERM, which batch systems send; it ends a command as Ctrl-C does."""

    signal = signal.SIGTERM


def exit_code(
    run: Callable[[], None], *, spoken: Mapping[str, str] | None = None, debug: bool = False
) -> int:
    """Run a command. An error becomes one message on stderr and an exit code.

    `spoken` maps the library's argument names, which messages contain, to options. With `debug`,
    errors are raised with their traceback.
    """
    spoken = spoken or {}
    try:
        with _sigterm_raises():
            run()
            sys.stdout.flush()
        return 0
    except SystemExit as end:  # raised by tyro, after it has printed help or an error
        return end.code if isinstance(end.code, int) else FAILED
    except KeyboardInterrupt as stop:
        if hasattr(stop, "fitted"):  # an interrupted training, whose state has been saved
            _say(f"\n{stop} On the command line: run the same command with --resume.")
        else:
            _say("\nstopped; no file was left incomplete.")
        return 128 + getattr(stop, "signal", signal.SIGINT)
    except BrokenPipeError:
        # The reader of the output, such as `head`, has ended; there is no one to report to.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        if debug:
            raise
        text, code = describe(error)
        _say(f"error: {in_options(text, spoken)}")
        return code


def describe(error: Exception) -> tuple[str, int]:
    """Message and exit code of an error."""
    from ..learning import TrainingError
    from ..meshing import EmptyLevelSetError

    text = str(error)
    if isinstance(error, OSError):
        if error.strerror:  # set by the system only; the library's errors have a full message
            text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
        return text, BAD_INPUT if isinstance(error, _BAD_PATHS) else FAILED
    if isinstance(error, EmptyLevelSetError | TrainingError):
        return text, FAILED
    if isinstance(error, ValueError):
        return text, BAD_INPUT
    if isinstance(error, MemoryError):
        return f"out of memory. {text}".strip(), FAILED
    hint = "(run the same command with --debug for the traceback)"
    return f"{type(error).__name__}: {text or 'no message'} {hint}", FAILED


def in_options(message: str, spoken: Mapping[str, str]) -> str:
    """The message, followed by the options for the arguments (`name=`) that it mentions."""
    named = dict.fromkeys(re.findall(r"\b([a-z_]+)=", message))
    options = [spoken[name] for name in named if name in spoken]
    return f"{message} (On the command line: {', '.join(options)}.)" if options else message


@contextmanager
def notices_as_lines(spoken: Mapping[str, str]) -> Iterator[None]:
    """Print each notice of the library once, as one line on stderr; leave other warnings alone."""
    from ..datasets.capture import CaptureNotice
    from ..learning import TrainingNotice
    from ..motion import MotionNotice

    notices, printed = (CaptureNotice, MotionNotice, TrainingNotice), set()
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message, category, filename, lineno, file=None, line=None):
            if not issubclass(category, notices):
                usual(message, category, filename, lineno, file, line)
            elif str(message) not in printed:
                printed.add(str(message))
                _say(f"notice: {in_options(str(message), spoken)}")

        for notice in notices:
            warnings.simplefilter("always", notice)
        warnings.showwarning = show
        yield


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Raise `Terminated` on SIGTERM, so that temporary files are removed as after Ctrl-C."""
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
