"""The `xavatar` command.

Each subcommand is a module of this package with a dataclass `Options`, which defines its command
line, and a function `run(options)`, which imports what it needs. `COMMANDS` lists the subcommands.
A module may also define `parse(arguments, prog, description)` to parse its own command line.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from .._version import __version__

COMMANDS = {
    "fit": "fit an avatar to posed meshes and evaluate it on held-out frames",
    "evaluate": "compare an avatar with the held-out meshes of a capture",
    "animate": "render an avatar that follows a motion",
    "export": "write an avatar for other programs: rigged GLB, meshes, skinning weights",
    "view": "show an avatar in the browser, or write a self-contained HTML page",
    "convert": "convert a motion to another file format",
    "info": "describe this machine, or the contents of a file",
}
_HELP = """\
usage: xavatar COMMAND ...

Animatable avatars of one person: body, hands and face.

{commands}

xavatar COMMAND --help    options of a command
xavatar --version         version
--debug                   traceback of errors (after any command)

To try it without any data:
  xavatar fit --minutes 2
  xavatar animate out/fit_grab/avatar.npz bundled --out out/animation.webp
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default that of the process, and return its exit code.

    0: success; 1: the run failed; 2: invalid input; 130: Ctrl-C; 143: SIGTERM.
    """
    words, debug = _without_debug(arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        print(help_text(), end="", file=sys.stdout if words else sys.stderr)
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        print(f"xavatar {__version__}")
        return 0
    name = words[0]
    if name not in COMMANDS:
        from difflib import get_close_matches

        close = get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(COMMANDS)}."
        print(f"error: no command {name!r}; {hint}", file=sys.stderr)
        return 2
    command = import_module(f".{name}", __name__)
    return run_command(command, words[1:], prog=f"xavatar {name}", debug=debug)


def run_command(
    command: Any,
    arguments: Sequence[str] | None = None,
    *,
    prog: str,
    description: str | None = None,
    debug: bool = False,
) -> int:
    """Run a subcommand's module, by default with the arguments of the process.

    With `debug`, or `--debug` among the arguments, errors are raised with their traceback.
    """
    from .failures import exit_code, notices_as_lines
    from .options import parse, spoken_names

    words, asked = _without_debug(arguments)
    spoken = spoken_names(command)

    def run() -> None:
        if hasattr(command, "parse"):
            options = command.parse(words, prog, description)
        else:
            options = parse(command.Options, words, prog, description)
        with notices_as_lines(spoken):
            command.run(options)

    return exit_code(run, spoken=spoken, debug=debug or asked)


def help_text() -> str:
    """The output of `xavatar --help`."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {summary}" for name, summary in COMMANDS.items()]
    return _HELP.format(commands="\n".join(lines))


def _without_debug(arguments: Sequence[str] | None) -> tuple[list[str], bool]:
    words = list(sys.argv[1:] if arguments is None else arguments)
    return [word for word in words if word != "--debug"], "--debug" in words
