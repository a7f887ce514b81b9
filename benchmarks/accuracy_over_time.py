"""Held-out accuracy against minutes since the call of `fit`.

Question: how near to unseen motion is an avatar after so many minutes of a method, all that the
method does included, on this machine?

Each point is a run of its own with that budget, from an empty cache of first fields, since a
budget decides more than where a run is cut off: its frames, its schedule. The first fields of
`paper` are made before, as are body and capture; evaluation does not count.

    python benchmarks/accuracy_over_time.py --json curve.json --picture curve.png [--only NAME...]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from charts import log_chart
from jaxtyping import UInt8
from resumable import Method, Posable, Row, add_options, every, fill, medians, score

import xavatar_jax as xa
from xavatar_jax.render import grid_picture, save_png
from xavatar_jax.training import FitConfig, initial_fields, subject_betas

MINUTES = (1.0, 1.5, 2.0, 4.0, 7.0, 10.0, 20.0, 30.0)
NAMES = ("quick", "paper")
STEPS = 100_000  # more than any budget here holds: minutes decide


def configured(preset: str, minutes: float, seed: int, small: bool) -> FitConfig:
    """A preset that ends by time alone."""
    config = xa.quick() if preset == "quick" else xa.paper()
    config = replace(config, seed=seed, steps=STEPS, minutes=minutes)
    if small:
        config = replace(config, minutes=None, steps=6, train_frames=3, prefit_steps=20)
    return config


def fit_preset(
    frames: xa.Frames, minutes: float, seed: int, *, preset: str, small: bool, cache: str | None
) -> Posable:
    """An avatar by a preset of the library."""
    config = configured(preset, minutes, seed, small)
    if preset == "paper":
        return xa.fit(frames, config, cache=cache, verbose=False).avatar
    with tempfile.TemporaryDirectory() as empty:
        return xa.fit(frames, config, cache=empty, verbose=False).avatar


def methods(args: argparse.Namespace) -> Mapping[str, Method]:
    """What is compared, by name. Others join as functions of frames, minutes and seed."""
    return {
        name: partial(fit_preset, preset=name, small=args.quick, cache=args.cache_dir)
        for name in NAMES
    }


def measure(
    name: str, minutes: float, seed: int, *, capture: Any, args: argparse.Namespace
) -> dict[str, Any]:
    """Figures of one run."""
    if name == "paper":
        initial_fields(
            capture.body, configured(name, minutes, seed, args.quick), cache=args.cache_dir
        )
    betas = jnp.asarray(subject_betas(capture.train))
    clock = time.perf_counter()
    model = methods(args)[name](capture.train, minutes, seed)
    spent = time.perf_counter() - clock
    figures = score(model, capture.body, betas, capture.test, args.eval_frames)
    record = {"fit_s": spent, **figures}
    if isinstance(model, xa.Avatar):
        record |= {"best_step": model.steps}
    return record


def picture(rows: Sequence[Row], minutes: Sequence[float]) -> UInt8[np.ndarray, "H W 3"]:
    """Chamfer distance over minutes, the whole body beside the hands; medians over seeds."""
    found = medians(rows, ("name", "minutes"))
    charts = []
    for region, title in (("all", "Chamfer, whole body, mm"), ("hands", "Chamfer, hands, mm")):
        key = f"cd_{region}_mm"
        lines: dict[str, list[tuple[float, float]]] = {}
        for row in sorted(found, key=lambda row: row["minutes"]):
            if row.get(key):
                lines.setdefault(row["name"], []).append((row["minutes"], row[key]))
        ticks = [m for m in minutes if any(m == x for line in lines.values() for x, _ in line)]
        charts.append(log_chart(lines, title=title, x_label="minutes", x_ticks=ticks))
    return grid_picture([charts])


def main() -> None:
    parser = argparse.ArgumentParser(description="Accuracy against minutes.")
    add_options(parser, NAMES, minutes=MINUTES, seeds=1)
    parser.add_argument("--picture", help="draw the curves into this PNG")
    args = parser.parse_args()
    if args.quick:
        args.eval_frames, args.minutes = 1, [1.0]
    names = args.only or (("quick",) if args.quick else NAMES)
    capture = xa.synthetic_capture(args.cache_dir)
    _, rows = fill(
        every(seed=range(args.seeds), name=names, minutes=args.minutes),
        lambda **job: measure(**job, capture=capture, args=args),
        question="held-out accuracy against minutes since the call of fit",
        settings={"quick": args.quick, "eval_frames": args.eval_frames, "data": capture.name},
        file=args.json,
        by=("name", "minutes"),
        columns=("cd_all_mm", "cd_hands_mm", "cd_face_mm", "fit_s", "best_step"),
    )
    if args.picture:
        save_png(args.picture, picture(rows, args.minutes))
        print(f"written: {args.picture}")


if __name__ == "__main__":
    main()
