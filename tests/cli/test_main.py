"""The command itself: help, exit codes, messages, and where it is installed."""

from __future__ import annotations

import ast
import importlib
import os
import re
import signal
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

import xavatar_jax as xa
from xavatar_jax import cli
from xavatar_jax.cli.failures import exit_code, in_options, notices_as_lines
from xavatar_jax.cli.options import option_names
from xavatar_jax.learning import Interrupted, TrainingError
from xavatar_jax.meshing import EmptyLevelSetError
from xavatar_jax.motion import MotionNotice

ROOT = Path(__file__).resolve().parents[2]
SOURCE = Path(xa.__file__).parent


def python(*words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(SOURCE.parent)}
    return subprocess.run(
        [sys.executable, *words], env=environment, capture_output=True, text=True, check=False
    )


def test_help_comes_without_waiting_for_jax():
    code = (
        "import sys; from xavatar_jax.cli import main; code = main(sys.argv[1:]); "
        "assert 'jax' not in sys.modules; sys.exit(code)"
    )
    for words in (["--help"], ["fit", "--help"], ["--version"]):
        done = python("-c", code, *words)
        assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"xavatar {xa.__version__}\n"


def test_it_runs_as_a_module_and_as_a_script():
    done = python("-m", "xavatar_jax", "nonsense")
    assert (done.returncode, done.stdout) == (2, "")
    assert "no command 'nonsense'; there are fit, evaluate" in done.stderr
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, name = project["scripts"]["xavatar"].partition(":")
    assert getattr(importlib.import_module(module), name) is cli.main


def test_every_command_has_a_module_and_a_line_of_help(call):
    code, said, _ = call("--help")
    assert code == 0
    for name in cli.COMMANDS:
        assert re.search(rf"^  {name} +\w", said, re.MULTILINE)
    files = {
        path.stem for path in (SOURCE / "cli").glob("*.py") if "\ndef run(" in path.read_text()
    }
    assert files == set(cli.COMMANDS)
    assert call()[0] == 2
    assert call("exprot")[::2] == (2, "error: no command 'exprot'; did you mean export?\n")


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_of_a_command_names_every_option(call, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, said, error = call(name, "--help")
    assert (code, error) == (0, "")
    options = option_names(importlib.import_module(f"xavatar_jax.cli.{name}").Options)
    for option in options.values():
        assert re.search(rf"{option}\b", said), option
    assert "None" not in said
    # Lines that are the same in a terminal of any width.
    about = said.split("╭")[0].splitlines()
    assert max(map(len, about)) <= 96


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ValueError("a.npz: poses has shape (3,)"), 2, "error: a.npz: poses has shape (3,)"),
        (FileNotFoundError("no body model found"), 2, "error: no body model found"),
        (FileNotFoundError(2, "No such file", "a.npz"), 2, "error: a.npz: No such file"),
        (OSError(28, "No space left"), 1, "error: No space left"),
        (TrainingError("the loss is nan"), 1, "error: the loss is nan"),
        (EmptyLevelSetError("no surface"), 1, "error: no surface"),
        (MemoryError("40 GB"), 1, "error: out of memory. 40 GB"),
        (TypeError("a fault"), 1,
         "error: TypeError: a fault (run the same command with --debug for the traceback)"),
        (KeyboardInterrupt(), 130, "stopped; no file was left incomplete."),
        (Interrupted("kept.", step=3, signal=15, fitted=None), 143,
         "kept. On the command line: run the same command with --resume."),
        (SystemExit(2), 2, ""),
    ],
)  # fmt: skip
def test_how_errors_end_a_command(error, code, message, capsys):
    def fails():
        raise error

    assert exit_code(fails) == code
    said = capsys.readouterr()
    assert (said.out, said.err.strip()) == ("", message)


def test_debug_shows_where(call, tmp_path):
    with pytest.raises(FileNotFoundError):
        cli.main(["info", str(tmp_path / "missing"), "--debug"])
    with pytest.raises(FileNotFoundError):
        cli.main(["--debug", "info", str(tmp_path / "missing")])


def test_sigterm_ends_a_command_as_ctrl_c_does(capsys):
    before = signal.getsignal(signal.SIGTERM)
    cleaned = []

    def run():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            cleaned.append(True)

    assert exit_code(run) == 143
    assert cleaned
    assert signal.getsignal(signal.SIGTERM) is before


def test_messages_name_options_and_notices_come_once(capsys):
    spoken = {"fps": "--file-fps", "body": "--body"}
    assert in_options("pass body=xa.load_body(...)", spoken).endswith(
        "(On the command line: --body.)"
    )
    assert in_options("rate is 3; other=1", spoken) == "rate is 3; other=1"
    with notices_as_lines(spoken):
        for _ in range(2):
            warnings.warn("no rate; pass fps= if it is another", MotionNotice, stacklevel=1)
        with pytest.raises(UserWarning, match="of somebody else"):  # the tests' own filter
            warnings.warn("of somebody else", UserWarning, stacklevel=1)
    assert capsys.readouterr().err == (
        "notice: no rate; pass fps= if it is another (On the command line: --file-fps.)\n"
    )


def test_a_reader_that_leaves_ends_it_quietly():
    command = f"{sys.executable} -m xavatar_jax info | true"
    environment = {**os.environ, "PYTHONPATH": str(SOURCE.parent)}
    done = subprocess.run(["bash", "-c", command], env=environment, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_names_of_the_library_are_imported_when_asked_for():
    """The list that type checkers read is the one that is used."""
    tree = ast.parse((SOURCE / "__init__.py").read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    listed = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert listed == xa._NAMES
    for name, home in listed.items():
        assert getattr(xa, name) is getattr(importlib.import_module(f"xavatar_jax.{home}"), name)
    assert set(listed) <= set(dir(xa))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = xa.nonsense


def test_a_command_may_be_any_module_like_object():
    """As for the example, which runs `fit` under its own name."""
    seen = []
    command = SimpleNamespace(Options=importlib.import_module("xavatar_jax.cli.info").Options,
                              run=seen.append)  # fmt: skip
    assert cli.run_command(command, ["some.file"], prog="script.py") == 0
    assert seen[0].file == Path("some.file")
