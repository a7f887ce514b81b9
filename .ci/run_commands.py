"""Runs the `xavatar` commands of a page, in order, in an empty folder.

python .ci/run_commands.py docs/command-line.md --bin VENV/bin --work FOLDER

`fit` without a number of steps is cut short by `--minutes 0.5`.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from pathlib import Path


def commands(page: Path) -> list[str]:
    """Lines of the page's shell blocks that call `xavatar`, without the folder of the program."""
    text = page.read_text(encoding="utf-8")
    lines = "".join(re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)).splitlines()
    found = [line.removeprefix(".venv/bin/") for line in lines if ".venv/bin/xavatar" in line]
    return [re.sub(r"^(xavatar fit .*--minutes) \S+", r"\1 0.5", line) for line in found]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("--bin", type=Path, required=True, help="folder of the program")
    parser.add_argument("--work", type=Path, required=True, help="empty folder to run in")
    options = parser.parse_args()
    options.work.mkdir(parents=True)
    for command in commands(options.page):
        began = time.monotonic()
        words = command.split()
        done = subprocess.run(
            [str(options.bin.resolve() / words[0]), *words[1:]],
            cwd=options.work,
            capture_output=True,
            text=True,
            check=False,
        )
        print(f"{time.monotonic() - began:6.1f} s  {command}", flush=True)
        if done.returncode:
            sys.exit(f"{done.stdout}\n{done.stderr}\nexit code {done.returncode}: {command}")


if __name__ == "__main__":
    main()
