"""Peak memory of training with few and with many available frames.

Question: does the memory of `fit` grow with the length of the sequences? Each frame count runs in a
separate process, whose peak is read after training and after an evaluation.

    python benchmarks/memory.py [--quick] [--counts 500 10000] [--json FILE]

The frames repeat those of the bundled capture with perturbed poses. They are posed on access, as
frames of a long recording are read from files.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import replace
from typing import Any

NOISE_DEG = 5.0
LENGTH = 500  # frames per sequence


def many_frames(capture: Any, count: int, seed: int = 0) -> Any:
    """`count` lazy frames, in sequences of `LENGTH`."""
    import numpy as np

    from xavatar_jax.frames import frames_from_params

    rng = np.random.default_rng(seed)
    params = capture.train.params[np.arange(count) % len(capture.train)]
    pose = np.asarray(params.pose)
    pose = pose + np.deg2rad(NOISE_DEG) * rng.standard_normal(pose.shape).astype(pose.dtype)
    index = np.arange(count) // LENGTH
    names = [f"sequence {k}" for k in range(index[-1] + 1)]
    return frames_from_params(
        capture.body, replace(params, pose=pose), sequence_names=names, sequence_index=index
    )


def learn(count: int, steps: int, train_frames: int, cache: str | None) -> dict[str, Any]:
    """Train on `count` frames in this process; peaks in MiB after each stage."""
    import xavatar_jax as xa
    from xavatar_jax.report.machine import peak_rss_mb

    capture = xa.synthetic_capture(cache)
    frames = many_frames(capture, count)
    row: dict[str, Any] = {"frames": count, "peak_rss_before_mb": peak_rss_mb()}
    started = time.perf_counter()
    config = replace(xa.quick(), steps=steps, train_frames=train_frames)
    result = xa.fit(frames, config, cache=cache, verbose=False)
    row |= {"peak_rss_fit_mb": peak_rss_mb(), "fit_s": time.perf_counter() - started}
    row["learned_from"] = len(result.frames)
    xa.evaluate(result.avatar, capture.test, num_frames=2, verbose=False)
    return {**row, "peak_rss_all_mb": peak_rss_mb()}


def in_a_child(count: int, args: argparse.Namespace) -> dict[str, Any]:
    """The row of `learn`, run in a new process, so that peaks do not include this one."""
    words = [sys.executable, __file__, "--child", str(count), "--steps", str(args.steps)]
    words += ["--train-frames", str(args.train_frames)]
    words += ["--cache-dir", args.cache_dir] if args.cache_dir else []
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description="Peak memory of training with many frames.")
    parser.add_argument("--counts", type=int, nargs="+", default=[500, 10_000])
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--train-frames", type=int, default=200)
    parser.add_argument("--quick", action="store_true", help="40 training frames, 25 steps")
    parser.add_argument("--json", help="JSON file for header and rows")
    parser.add_argument("--cache-dir")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(learn(args.child, args.steps, args.train_frames, args.cache_dir)))
        return
    if args.quick:
        args.steps, args.train_frames = 25, 40
    # Import the library after the children have run: the memory of a process when it forks
    # counts towards the peak of the child.
    rows = [in_a_child(count, args) for count in args.counts]
    from measuring import print_rows, write_result

    from xavatar_jax.report import describe_machine

    print_rows(rows, tuple(rows[0]))
    header = {"question": "does the memory of fit grow with the number of frames"}
    header |= {**describe_machine(), "steps": args.steps, "quick": args.quick}
    write_result(args.json, header, rows)


if __name__ == "__main__":
    main()
