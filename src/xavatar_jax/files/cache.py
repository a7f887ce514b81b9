"""The cache folder, and entries in it that are built once and verified whenever they are read."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from .atomic import atomic_folder, atomic_path

T = TypeVar("T")
_CONTENTS = "contents.json"  # in a folder: the SHA-256 of every file by its relative path
_DIGEST = 64  # hexadecimal digits of a SHA-256
_END = b"PK\x05\x06"  # start of the last record of a zip file; it ends with the comment's length


_UNCHECKED = "no checksum"


class CacheNotice(UserWarning):
    """A cache entry was damaged or incomplete and has been built again."""


def cache_path(override: str | os.PathLike[str] | None = None) -> Path:
    """The folder of bodies, captures and pre-fits, which may not exist yet.

    `override`, or the user's cache folder (`XDG_CACHE_HOME` is honoured); a temporary folder if
    no home folder is known.
    """
    if override is not None:
        return Path(override).expanduser()
    import platformdirs

    try:
        path = Path(platformdirs.user_cache_dir("xavatar_jax", appauthor=False))
    except RuntimeError:  # no home folder; older versions of platformdirs leave a "~"
        path = Path("~")
    return Path(tempfile.gettempdir()) / "xavatar_jax" if path.parts[0] == "~" else path


def cached(
    path: Path, build: Callable[[Path], object], read: Callable[[Path], T], *, folder: bool = False
) -> T:
    """Read a cache entry, building it first if it is missing, damaged or incomplete.

    The entry is written under a temporary name together with its SHA-256: in the comment of an
    archive, or in `contents.json` for every file of a folder. Rebuilding a damaged entry is
    reported once, as a `CacheNotice`.

    Args:
        path: the `.npz` file or the folder.
        build: writes the entry to the temporary path it is given.
        read: reads it. For a file without a checksum, as earlier versions wrote it, `ValueError`
            and `OSError` count as damage.
        folder: whether the entry is a folder.

    Raises:
        OSError: the entry cannot be written; names the path.
    """
    damage = _folder_damage(path) if folder else _file_damage(path)
    if damage is None:
        return read(path)
    if damage == _UNCHECKED:
        try:
            return read(path)
        except (ValueError, OSError) as error:
            damage = str(error)
    if damage:
        warnings.warn(
            f"{path}: damaged cache entry, built again ({damage})", CacheNotice, stacklevel=3
        )
    try:
        if folder:
            _build_folder(path, build)
        else:
            _build_file(path, build)
    except OSError as error:
        raise OSError(
            error.errno,
            f"cannot write to the cache: {error.strerror or error}; XDG_CACHE_HOME or the cache "
            "argument selects another folder",
            str(path),
        ) from error
    return read(path)


def _file_damage(path: Path) -> str | None:
    """What is wrong with an archive: None for nothing, "" if it does not exist."""
    if not path.exists():
        return ""
    if not path.is_file():
        return "not a file"
    data = path.read_bytes()
    digest = data[-_DIGEST:]
    end = len(data) - _DIGEST - 22
    if data[max(end, 0) : end + 4] != _END:
        return _UNCHECKED
    if hashlib.sha256(data[: -_DIGEST - 2]).hexdigest().encode() != digest:
        return "its checksum does not match"
    return None


def _build_file(path: Path, build: Callable[[Path], object]) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    with atomic_path(path) as temporary:
        build(temporary)
        data = temporary.read_bytes()[:-2]  # without the length of the comment, which is 0
        digest = hashlib.sha256(data).hexdigest().encode()
        temporary.write_bytes(data + _DIGEST.to_bytes(2, "little") + digest)


def _folder_damage(path: Path) -> str | None:
    """What is wrong with a folder: None for nothing, "" if it does not exist."""
    if not path.exists():
        return ""
    try:
        wanted = dict(json.loads((path / _CONTENTS).read_text(encoding="utf-8")))
        found = _checksums(path)
    except (OSError, ValueError, TypeError) as error:
        return f"no readable {_CONTENTS}: {error}"
    names = sorted(name for name in wanted.keys() | found if wanted.get(name) != found.get(name))
    return f"missing, changed or unexpected: {', '.join(names)}" if names else None


def _checksums(folder: Path) -> dict[str, str]:
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != _CONTENTS]
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files
    }


def _build_folder(path: Path, build: Callable[[Path], object]) -> None:
    with atomic_folder(path) as temporary:
        build(temporary)
        contents = json.dumps(_checksums(temporary), indent=1)
        (temporary / _CONTENTS).write_text(contents, encoding="utf-8")
        if path.exists() and _folder_damage(path) is not None:
            # Otherwise another process was quicker, and `atomic_folder` keeps its folder.
            old = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
            os.replace(path, old / path.name)
            shutil.rmtree(old, ignore_errors=True)
