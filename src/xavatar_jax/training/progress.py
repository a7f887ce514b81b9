"""Progress bars that are silent without a terminal, or when asked."""

from __future__ import annotations

from typing import Any


def progress(what: str, total: int | None, *, verbose: bool, unit: str = "it") -> Any:
    """A tqdm bar with an ETA. Hidden if not `verbose`, and where there is no terminal."""
    from tqdm.auto import tqdm

    return tqdm(
        total=total, desc=what, unit=unit, disable=None if verbose else True, dynamic_ncols=True
    )
