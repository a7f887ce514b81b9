"""Speed and error of animation and rigged export.

Question: how many frames per second does `Avatar.animate` pose, how far are they from the meshes of
`Avatar.mesh`, and how long do a GLB file of 300 frames and the canonical surface at several cell
sizes take?

    python benchmarks/animate.py out/fit_grab/avatar.npz [--quick] [--json FILE]
    python benchmarks/animate.py out/paper/avatar.npz --surface [--quick] [--json FILE]

The avatar is written by `examples/fit_grab.py` and uses the bundled body. The motion consists of
the held-out sequences, concatenated. There is one row per value of `offsets`; distances are to
`Avatar.mesh` of the same frame. `--surface` only measures the canonical surface.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from measuring import peak_rise_mb, write_result

import xavatar_jax as xa
from xavatar_jax.avatar import Animation, GlbExport
from xavatar_jax.report import describe_machine

OFFSETS = ("cached", "none", "exact")
CELLS = {
    "default: 2 mm at hands and face to 8 mm": xa.CellSizes(),
    "1.5 mm at hands and face to 6 mm": xa.CellSizes().scaled(0.75),
    "4 mm all over": 0.004,
    "1.5 mm all over": 0.0015,
}


def held_out_motion(body: xa.BodyModel, frames: int) -> xa.Motion:
    """The first `frames` frames of the bundled capture's held-out sequences, joined."""
    parts = [part.params for part in xa.synthetic_capture(body=body).test.sequences.values()]
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:frames], *parts)
    return xa.Motion.from_params(joined, fps=30, source="held-out sequences")


def measure_animation(animation: Animation, timed: int, compared: int) -> dict[str, Any]:
    """Wall and CPU time per frame, milliseconds, and distances, millimetres."""
    animation.frame_vertices(0)  # compiles
    wall, processor = time.perf_counter(), time.process_time()
    for k in range(timed):
        animation.frame_vertices(k % len(animation))
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    row = {
        "offsets": animation.offsets,
        "frames_per_s": timed / wall,
        "ms_per_frame": 1000 * wall / timed,
        "processor_ms_per_frame": 1000 * processor / timed,
        "frames_timed": timed,
    }
    if animation.offsets != "exact":
        error = animation.error(compared)
        for name, spread in (("vertex", error.vertex), ("surface", error.surface)):
            row |= {f"{name}_{k}_mm": v for k, v in spread._asdict().items()}
        row["frames_compared"] = error.frames
    return row


def measure_export(avatar: xa.Avatar, motion: xa.Motion, influences: Any) -> dict[str, Any]:
    """Seconds of a second export, file size, and error of the rig."""
    with tempfile.TemporaryDirectory() as folder:
        report: GlbExport | None = None
        seconds = 0.0
        for _ in range(2):
            start = time.perf_counter()
            path = Path(folder) / "avatar.glb"
            report = avatar.export_glb(path, motion, influences=influences, verbose=False)
            seconds = time.perf_counter() - start
    assert report is not None
    assert report.influence_loss is not None
    assert report.total_loss is not None
    return {
        "influences": influences,
        "seconds": seconds,
        "megabytes": report.num_bytes / 1e6,
        "influences_mean_mm": report.influence_loss.mean,
        "influences_max_mm": report.influence_loss.max,
        "rig_mean_mm": report.total_loss.mean,
        "rig_max_mm": report.total_loss.max,
    }


def measure_extraction(avatar: xa.Avatar, cells: str) -> dict[str, Any]:
    """Seconds of a first and a second extraction without vertex limit, and memory increase."""
    taken, vertices = [], 0

    def extract() -> None:
        nonlocal vertices
        start = time.perf_counter()
        mesh = avatar.canonical_mesh(cell=CELLS[cells], max_vertices=None)
        taken.append(time.perf_counter() - start)
        vertices = mesh.num_vertices

    rise = peak_rise_mb(extract)
    extract()
    return {
        "cells": cells,
        "vertices": vertices,
        "first_s": taken[0],
        "seconds": taken[-1],
        "rss_rise_mb": rise,
    }


def measure_motion(
    avatar: xa.Avatar, quick: bool
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, Any]]:
    """Rows of animation and of export, and the costs before the first frame."""
    motion = held_out_motion(avatar.body, 60 if quick else 300)
    start = time.perf_counter()
    avatar.canonical_mesh()
    extracted = time.perf_counter()
    jax.block_until_ready(avatar.rest)
    ready = time.perf_counter()
    rows = [
        measure_animation(
            avatar.animate(motion, offsets=offsets),
            {"exact": 3}.get(offsets, 30 if quick else 300),
            2 if quick else 12,
        )
        for offsets in OFFSETS
    ]
    exports = [measure_export(avatar, motion, influences) for influences in (4, 8)]
    return (
        rows,
        exports,
        {
            "vertices": avatar.canonical_mesh().num_vertices,
            "frames": len(motion),
            "extraction_s": extracted - start,
            "base_s": ready - extracted,
        },
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("avatar", help="avatar.npz of examples/fit_grab.py")
    parser.add_argument("--quick", action="store_true", help="fewer frames")
    parser.add_argument("--surface", action="store_true", help="measure the canonical surface only")
    parser.add_argument("--json", help="JSON file for the results")
    args = parser.parse_args()
    body = xa.synthetic_body()
    avatar = xa.load_avatar(args.avatar, body=body)
    rows, exports, base = [], [], {}
    if not args.surface:
        rows, exports, base = measure_motion(avatar, args.quick)  # pyright: ignore[reportArgumentType]
    sizes = list(CELLS)[:1] if args.quick else CELLS
    extractions = [measure_extraction(avatar, cells) for cells in sizes]  # pyright: ignore[reportArgumentType]
    header = {
        "question": "frames a second of animation, distance to exact frames, time of export",
        **describe_machine(),
        "quick": args.quick,
        "preset": avatar.options["preset"],
        **base,
        "exports": exports,
        "extractions": extractions,
    }
    for row in (*rows, *exports, *extractions):
        print(
            ", ".join(
                f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()
            )
        )
    write_result(args.json, header, rows)


if __name__ == "__main__":
    main()
