"""A run's log: one JSON object a line, whole lines only."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..files import atomic_path


class JsonLines:
    """Appends records to a file, each flushed as it comes.

    With `after` given, an existing file is continued: records of later steps, which a resumed run
    makes anew, are dropped. Otherwise a former file is replaced.
    """

    def __init__(self, path: str | os.PathLike[str], *, after: int | None = None):
        self._path = Path(path)
        kept: list[dict[str, Any]] = []
        if after is not None and self._path.exists():
            kept = [line for line in read_log(self._path) if line.get("step", 0) <= after]
        with atomic_path(self._path) as temporary:
            temporary.write_text("".join(_line(record) for record in kept), encoding="utf-8")
        self.empty = not kept

    def write(self, record: Mapping[str, Any]) -> None:
        with open(self._path, "a", encoding="utf-8") as file:
            file.write(_line(record))


def read_log(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Records of a log; a last line that was cut off is left out.

    **Raises:** `ValueError` naming file and line for any other line that is not JSON.
    """
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    records = []
    for number, line in enumerate(lines, 1):
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number == len(lines):
                break
            raise ValueError(f"{os.fspath(path)}, line {number}: not JSON ({error})") from error
    return records


def _line(record: Mapping[str, Any]) -> str:
    """One line; what is not finite becomes null, which JSON has a word for."""
    plain = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in record.items()
    }
    return json.dumps(plain, allow_nan=False) + "\n"
