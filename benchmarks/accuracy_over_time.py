"""Held-out accuracy against minutes since the call of `fit`.

Question: how accurate is an avatar on held-out motion after a given number of minutes, with all
setup included, on this machine?

Each point is a separate run with its own time limit and an empty cache of first fields, because
the limit also determines the number of frames and the learning-rate schedule. The first fields of
`paper`, the body and the capture are prepared before. Evaluation is excluded.

    python benchmarks/accuracy_over_time.py --json curve.json --picture curve.png [--only NAME...]

`--table2 FILE` reuses the runs of table 2 as points of the curve.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from methods import METHODS, learn
from resumable import Row, add_options, every, fill, medians, read_options, rows_of, score

import xavatar_jax as xa
from xavatar_jax.render import grid_picture, save_png
from xavatar_jax.report import describe_machine, line_chart

MINUTES = (1.0, 1.5, 3.0, 4.0, 10.0, 30.0)
NAMES = ("quick", "paper", "SNARF", "SCANimate")


def measure(
    name: str, minutes: float, seed: int, *, capture: Any, args: argparse.Namespace
) -> dict[str, Any]:
    """Metrics of one run."""
    model, spent = learn(name, capture, minutes, seed, small=args.quick, cache=args.cache_dir)
    return {**spent, **score(model, capture.test, args.eval_frames)}


def points_of_table2(file: str, settings: Mapping[str, Any]) -> list[Row]:
    """Runs of table 2, with their minutes.

    **Raises:** `ValueError` if they have other settings or come from another machine.
    """
    rows = rows_of(Path(file), {**describe_machine(), **settings}, ("device", "cores", *settings))
    minutes = json.loads(Path(file).read_text(encoding="utf-8"))["header"]["minutes"]
    return [{**row, "minutes": minutes} for row in rows if row["name"] in NAMES]


def picture(rows: Sequence[Row], minutes: Sequence[float]) -> UInt8[np.ndarray, "H W 3"]:
    """Charts of Chamfer distance over minutes, whole body and hands; medians over seeds."""
    found = medians(rows, ("name", "minutes"))
    charts = []
    for region, title in (("all", "Chamfer, whole body, mm"), ("hands", "Chamfer, hands, mm")):
        key = f"cd_{region}_mm"
        lines: dict[str, list[tuple[float, float]]] = {}
        for row in found:
            if row.get(key):
                lines.setdefault(row["name"], []).append((row["minutes"], row[key]))
        lines = {name: sorted(line) for name, line in lines.items()}
        ticks = [m for m in minutes if any(m == x for line in lines.values() for x, _ in line)]
        charts.append(line_chart(lines, title=title, x_label="minutes", x_ticks=ticks))
    return grid_picture([charts])


def main() -> None:
    parser = argparse.ArgumentParser(description="Accuracy over minutes.")
    add_options(parser, METHODS, minutes=MINUTES, seeds=1)
    parser.add_argument("--picture", help="PNG file for the chart")
    parser.add_argument("--table2", help="JSON of table2_grab.py whose runs are reused")
    args = read_options(parser)
    names = args.only or (("quick",) if args.quick else NAMES)
    capture = xa.synthetic_capture(args.cache_dir)
    settings = {"quick": args.quick, "eval_frames": args.eval_frames, "data": capture.name}
    _, rows = fill(
        every(seed=range(args.seeds), name=names, minutes=args.minutes),
        lambda **job: measure(**job, capture=capture, args=args),
        question="held-out accuracy against minutes since the call of fit",
        settings=settings,
        file=args.json,
        by=("name", "minutes"),
        columns=("cd_all_mm", "cd_hands_mm", "cd_face_mm", "fit_s", "steps"),
        known=points_of_table2(args.table2, settings) if args.table2 else (),
    )
    if args.picture:
        save_png(args.picture, picture(rows, args.minutes))
        print(f"written: {args.picture}")


if __name__ == "__main__":
    main()
