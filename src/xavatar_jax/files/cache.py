"""Where things are kept that are made once."""

from __future__ import annotations

import os
from pathlib import Path


def cache_dir(override: str | os.PathLike[str] | None = None) -> Path:
    """Where bodies, captures and fitted starts are kept: `override`, or the user's cache folder.

    `XDG_CACHE_HOME` is honoured. The folder is made if it is missing.

    **Raises:** `OSError` if it cannot be made.
    """
    path = cache_path(override)
    path.mkdir(parents=True, exist_ok=True)
    return path


def cache_path(override: str | os.PathLike[str] | None = None) -> Path:
    """The same folder, whether or not it is there."""
    if override is not None:
        return Path(override).expanduser()
    import platformdirs

    return Path(platformdirs.user_cache_dir("xavatar_jax", appauthor=False))
