"""Metrics of the ground truth against itself: the best scores that sampling allows.

Question: both meshes of a comparison are sampled independently. What does the ground truth score
against itself, with the 10,000 samples of the metrics, and with more?

    python benchmarks/metric_floor.py [--frames N] [--json FILE]
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from measuring import print_rows, write_result

import xavatar_jax as xa
from xavatar_jax.frames import spread
from xavatar_jax.metrics import surface_metrics
from xavatar_jax.report import describe_machine

METRICS = {"cd_mm": "Chamfer", "nc": "normal consistency", "iou": "volume", "iou_box": "boxes"}
REGIONS = ("all", "hands", "face")


def floor_row(frames: xa.Frames, samples: int) -> dict[str, Any]:
    """Mean over frames of every metric of a mesh against itself."""
    found: dict[str, list[float]] = {}
    for frame in frames:
        mesh = xa.Mesh(np.asarray(frame.vertices), np.asarray(frame.faces))
        same = surface_metrics(mesh, mesh, labels=frame.part_labels, num_samples=samples)
        for metric in METRICS:
            for region in REGIONS:
                value = getattr(getattr(same, metric), region)
                found.setdefault(f"{metric}_{region}", []).append(float(value))
    return {"samples": samples, **{name: float(np.mean(v)) for name, v in found.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description="Metrics of the ground truth against itself.")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--json", help="JSON file for header and rows")
    parser.add_argument("--cache-dir")
    args = parser.parse_args()
    test = xa.synthetic_capture(args.cache_dir).test
    frames = test[spread(test, args.frames)]
    rows = [floor_row(frames, samples) for samples in (10_000, 100_000)]
    print_rows(rows, tuple(rows[0]))
    header = {"question": "metrics of the truth against itself", **describe_machine()}
    write_result(args.json, {**header, "frames": args.frames}, rows)


if __name__ == "__main__":
    main()
