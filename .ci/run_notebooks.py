"""Runs the notebooks from their first cell to their last, and fails where one fails.

    python .ci/run_notebooks.py FOLDER [NAME ...]

Copies with their outputs, and what the notebooks write, go into FOLDER. The environment says how
long they may take: XAVATAR_STEPS (of training), XAVATAR_SECONDS (of motion).
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
# In the order in which they name one another: the third loads what the second has saved.
ORDER = ("pose_a_body", "fit_an_avatar", "animate_and_export")


def main() -> None:
    folder = Path(sys.argv[1]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["XAVATAR_OUT"] = str(folder)
    for name in sys.argv[2:] or ORDER:
        started = time.perf_counter()
        notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
        client = NotebookClient(
            notebook,
            timeout=600,
            kernel_name="python3",
            resources={"metadata": {"path": str(folder)}},
        )
        try:
            client.execute()
        except CellExecutionError as error:
            sys.exit(f"{name}: {error}")
        finally:
            nbformat.write(notebook, folder / f"{name}.ipynb")
        shown = sum(
            "image/png" in out.get("data", {})
            for c in notebook.cells
            for out in c.get("outputs", ())
        )
        print(f"{name}: {time.perf_counter() - started:.0f} s, {shown} pictures", flush=True)


if __name__ == "__main__":
    main()
