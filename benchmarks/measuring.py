"""Timing, memory and tables, shared by the benchmarks."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from xavatar_jax.report import write_json


def least_time(run: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """Result of `run`, and its minimum time in seconds, blocking on results."""
    spent, result = [], None
    for _ in range(repeats):
        clock = time.perf_counter()
        result = jax.block_until_ready(run())
        spent.append(time.perf_counter() - clock)
    return result, min(spent)


def peak_rise_mb(run: Callable[[], Any]) -> float | None:
    """Peak increase of resident memory during `run`, MiB; None outside Linux."""
    mark, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    try:
        mark.write_text("5")  # reset the high-water mark
        before = _resident_kb(status, "VmRSS")
        run()
        return max(_resident_kb(status, "VmHWM") - before, 0) / 1024
    except OSError:
        return None


def _resident_kb(status: Path, name: str) -> int:
    line = next(v for v in status.read_text().splitlines() if v.startswith(name))
    return int(line.split()[1])


def print_rows(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> None:
    """Print some columns as a plain-text table."""
    cells = [[_cell(row.get(name)) for name in columns] for row in rows]
    widths = [max(len(c[k]) for c in [columns, *cells]) for k in range(len(columns))]
    for line in (list(columns), *cells):
        print("  ".join(f"{text:>{width}}" for text, width in zip(line, widths, strict=True)))


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.4g}"


def write_result(
    path: str | os.PathLike[str] | None, header: Mapping[str, Any], rows: Sequence[Any]
) -> None:
    """Write the result of a benchmark to a JSON file, if `path` is given."""
    if path:
        write_json(path, {"header": header, "rows": rows})
        print(f"written: {path}", flush=True)
