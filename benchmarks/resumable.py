"""Tables that take hours: rows are written as runs finish, and a second call continues.

A job holds the keyword arguments of one run, `{"name": ..., "seed": ..., more}`. A run returns
metrics. A row combines both, and a job is finished if the file has a row with its entries.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import jax
from measuring import print_rows

import xavatar_jax as xa
from xavatar_jax.avatar import Drivable
from xavatar_jax.frames import Frames
from xavatar_jax.report import describe_machine, write_json

Job = Mapping[str, Any]
Row = dict[str, Any]


def add_options(
    parser: argparse.ArgumentParser,
    names: Iterable[str],
    *,
    minutes: float | Sequence[float],
    seeds: int = 3,
    eval_frames: int = 12,
) -> None:
    """Add the options shared by these tables; a sequence of `minutes` makes `--minutes` a list."""
    several = not isinstance(minutes, float | int)
    parser.add_argument("--quick", action="store_true", help="small test run")
    parser.add_argument("--json", help="JSON file of the table; continues an existing one")
    parser.add_argument("--only", nargs="+", choices=list(names), metavar="NAME", help="of "
                        + ", ".join(names))  # fmt: skip
    parser.add_argument("--seeds", type=int, default=seeds, help="number of seeds, from 0")
    parser.add_argument("--minutes", type=float, default=minutes, nargs="+" if several else None,
                        help="minutes per run, from its call")  # fmt: skip
    parser.add_argument("--eval-frames", type=int, default=eval_frames, help="held-out frames")
    parser.add_argument("--cache-dir")


def read_options(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parsed options; `--quick` sets the size of a small run, the same for all tables."""
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.eval_frames = 1, 1
        args.minutes = 1.0 if isinstance(args.minutes, float | int) else [1.0]
    return args


def every(**values: Iterable[Any]) -> list[dict[str, Any]]:
    """One job per combination; the last entry changes fastest."""
    return [dict(zip(values, row, strict=True)) for row in product(*values.values())]


def fill(
    jobs: Sequence[Job],
    run: Callable[..., Mapping[str, Any]],
    *,
    question: str,
    settings: Mapping[str, Any],
    file: str | Path | None,
    by: Sequence[str] = ("name",),
    columns: Sequence[str] = (),
    known: Sequence[Row] = (),
) -> tuple[dict[str, Any], list[Row]]:
    """Header and rows of the table: calls `run(**job)` for each job that is not in the file.

    `settings` are shared by all rows (minutes, frames); a file with other settings or from another
    machine is rejected. `known` are rows of other tables that are reused. A failed run is
    reported and repeated by the next call; other runs continue. Compiled programs are dropped
    before every run, so that later runs have no advantage. Finally the medians are printed: see
    `print_medians` for `by` and `columns`.

    **Raises:** `ValueError` naming the file and what differs; `SystemExit` at the end if a run
    failed.
    """
    header = {"question": question, **describe_machine(), **settings}
    rows: list[Row] = []
    if file is not None and Path(file).exists():
        rows = rows_of(Path(file), header, ("device", "cores", "question", *settings))

    def keep(more: Sequence[Row]) -> None:
        rows.extend(more)
        if more and file is not None:
            write_json(file, {"header": header, "rows": rows})

    keep([row for row in known if row not in rows])
    failed = []
    for k, job in enumerate(jobs):
        label = ", ".join(str(v) if k == "name" else f"{k} {v}" for k, v in job.items())
        if any(job.items() <= row.items() for row in rows):
            print(f"[{k + 1}/{len(jobs)}] {label}: kept", flush=True)
            continue
        print(f"[{k + 1}/{len(jobs)}] {label} ...", flush=True)
        jax.clear_caches()
        gc.collect()
        clock = time.perf_counter()
        try:
            figures = run(**job)
        except Exception:
            traceback.print_exc()
            failed.append(label)
            continue
        spent = time.perf_counter() - clock
        row = {**job, **figures, "row_s": spent, "commit": header["commit"]}
        header["peak_rss_mb"] = describe_machine()["peak_rss_mb"]
        keep([{name: _plain(value) for name, value in row.items()}])
    rows = [row for row in rows if any(job.items() <= row.items() for job in jobs)]
    print(f"{header['device']}, {header['cores']} cores, commit {header['commit']}")
    print_medians(rows, by, columns)
    if file is not None:
        print(f"written: {file}")
    if failed:
        sys.exit(f"{len(failed)} of {len(jobs)} runs failed: {'; '.join(failed)}")
    return header, rows


def rows_of(file: Path, header: Mapping[str, Any], same: Iterable[str]) -> list[Row]:
    """Rows of an existing table with the same header.

    **Raises:** `ValueError` naming the file and the entries of `same` that differ.
    """
    known = json.loads(file.read_text(encoding="utf-8"))
    other = [
        f"{name} {known['header'].get(name)!r} (now {header[name]!r})"
        for name in same
        if known["header"].get(name) != json.loads(json.dumps(header[name]))
    ]
    if other:
        raise ValueError(f"{file}: a table with {', '.join(other)}. Use those, or another file")
    return known["rows"]


def medians(rows: Sequence[Row], by: Sequence[str] = ("name",)) -> list[Row]:
    """Medians and number of seeds, one row per distinct `by`, in order of appearance."""
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    return [
        {
            **dict(zip(by, key, strict=True)),
            "seeds": len(members),
            **{name: _median(members, name) for name in _figures(members, by)},
        }
        for key, members in groups.items()
    ]


def _figures(rows: Sequence[Row], by: Sequence[str]) -> list[str]:
    """Names of entries that are numbers in some row."""
    names = {name: None for row in rows for name, value in row.items() if _is_number(value)}
    return [name for name in names if name not in (*by, "seed")]


def _median(rows: Sequence[Row], name: str) -> float | None:
    values = [row[name] for row in rows if _is_number(row.get(name))]
    return median(values) if values else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def print_medians(
    rows: Sequence[Row], by: Sequence[str] = ("name",), columns: Sequence[str] = ()
) -> None:
    """Print the medians as a table: `by`, then `columns` (default: all metrics)."""
    found = medians(rows, by)
    if found:
        print_rows(found, [*by, "seeds", *(columns or _figures(found, (*by, "seeds")))])


def score(model: Drivable, frames: Frames, count: int) -> dict[str, float | None]:
    """Held-out metrics of `xa.evaluate`, named by metric and region: `cd_hands_mm` and so on."""
    mean = xa.evaluate(model, frames, num_frames=count, verbose=False).mean.to_json()
    found = {}
    for figure in ("cd_mm", "cd_max_mm", "nc", "iou", "iou_box"):
        stem, unit = (figure[:-3], "_mm") if figure.endswith("_mm") else (figure, "")
        for region, value in mean[figure].items():
            found[f"{stem}_{region}{unit}"] = value
    return found


def _plain(value: Any) -> Any:
    """A JSON value; non-finite numbers become null."""
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
