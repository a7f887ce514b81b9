"""Where a command may write: looked at before any work is done."""

from __future__ import annotations

import os
from pathlib import Path


def check_file(path: Path) -> None:
    """**Raises:** `OSError` saying why no file can be written at `path`."""
    if path.is_dir():
        raise IsADirectoryError(f"{path}: there is a folder of this name; name a file")
    _check_place(path)


def check_folder(path: Path) -> None:
    """**Raises:** `OSError` saying why no files can be written into a folder at `path`."""
    _check_place(path / "file")


def check_new_folder(path: Path) -> None:
    """**Raises:** `OSError` saying why no new folder can be made at `path`."""
    if path.exists():
        raise FileExistsError(f"{path}: there already; name a new folder, or remove this one")
    _check_place(path)


def _check_place(path: Path) -> None:
    """The nearest folder above that exists has to take files, or folders for them."""
    above = path.absolute().parent
    while not above.exists() and above != above.parent:
        above = above.parent
    if not above.is_dir():
        raise NotADirectoryError(f"{path}: cannot be written, since {above} is no folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: cannot be written, since {above} takes no files")


def written(path: Path | str, what: str = "", *, quiet: bool) -> None:
    """Say on stdout what was written."""
    if not quiet:
        print(f"{path}: {what}" if what else str(path), flush=True)
