"""The `xavatar` command.

A subcommand is one module of this package with a dataclass `Options`, which is its command line,
and `run(options)`, which imports what it needs; and one line in `COMMANDS`. It may have
`parse(arguments, prog, description)` if its options alone do not say how to read its command line.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from .._version import __version__

COMMANDS = {
    "fit": "learn an avatar from posed meshes, and test it",
    "evaluate": "compare an avatar with meshes it has not seen",
    "animate": "pictures of an avatar that follows a motion",
    "export": "rigged GLB, meshes, sequences of meshes, skinning weights",
    "view": "an avatar in the browser, or one page that plays anywhere",
    "convert": "a motion from one file format to another",
    "info": "this machine, or what is in a file",
}
_HELP = """\
usage: xavatar COMMAND ...

Animatable avatars of one person: body, hands and face.

{commands}

xavatar COMMAND --help    options of a command
xavatar --version         version
--debug                   after any command: show where an error comes from

Try it without any data:
  xavatar fit --minutes 2
  xavatar animate out/fit_grab/avatar.npz bundled --out out/animation.webp
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default that of the process. Returns its exit code.

    0: done; 1: the run failed; 2: the input is wrong; 130: Ctrl-C, 143: SIGTERM.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
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
    return run_command(
        import_module(f".{name}", __name__), words[1:], prog=f"xavatar {name}", debug=debug
    )


def run_command(
    command: Any,
    arguments: Sequence[str] | None = None,
    *,
    prog: str,
    description: str | None = None,
    debug: bool = False,
) -> int:
    """Run the module of one subcommand, by default with the arguments of the process.

    With `debug`, or `--debug` among the arguments, errors come with their traceback.
    """
    from .failures import exit_code, notices_as_lines
    from .options import parse, spoken_names

    words = list(sys.argv[1:] if arguments is None else arguments)
    debug |= "--debug" in words
    words = [word for word in words if word != "--debug"]

    def run() -> None:
        own_parse = getattr(command, "parse", None)
        if own_parse is not None:
            options = own_parse(words, prog, description)
        else:
            options = parse(command.Options, words, prog, description)
        with notices_as_lines(spoken):
            command.run(options)

    spoken = spoken_names(command)
    return exit_code(run, spoken=spoken, debug=debug)


def help_text() -> str:
    """What `xavatar --help` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {summary}" for name, summary in COMMANDS.items()]
    return _HELP.format(commands="\n".join(lines))
