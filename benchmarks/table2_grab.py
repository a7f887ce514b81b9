"""X-Avatar's comparison on GRAB: ours, SNARF and SCANimate at equal time.

Question: how near are avatars of each method to meshes of motion that none has seen, when each
learns for the same minutes?

    python benchmarks/table2_grab.py [--quick] [--json FILE] [--data FOLDER --body FILE]

The bundled capture, unless GRAB's own is given. SNARF and SCANimate are driven by a body-only
skeleton, as in the paper (its Table 2); `template weights` is ours with the skinning weights of
the body, not learned. All begin with fields fitted to the body's mean shape, which is part of the
minutes (but for `paper` and the baselines in their papers' size, which `--only` adds). A row is
written as its run ends, and the same command goes on from there.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from methods import METHODS, learn
from resumable import add_options, every, fill, read_options, score

import xavatar_jax as xa
from xavatar_jax.avatar import Posable
from xavatar_jax.frames import spread

NAMES = ("quick", "template weights", "SNARF", "SCANimate")
FIGURES = ("cd", "cd_max", "nc", "iou")
COLUMNS = (
    *(
        f"{figure}_{region}{'_mm' if figure.startswith('cd') else ''}"
        for figure in FIGURES
        for region in ("all", "hands")
    ),
    *("fit_s", "steps", "mesh_ms"),
)


def measure_speed(model: Posable, frames: xa.Frames) -> float:
    """Milliseconds of a mesh in a new pose, once the canonical surface is there."""
    model.mesh(frames[0].params)
    clock = time.perf_counter()
    for k in range(1, len(frames)):
        model.mesh(frames[k].params)
    return 1000 * (time.perf_counter() - clock) / (len(frames) - 1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add_options(parser, METHODS, minutes=3.0)
    parser.add_argument("--data", help="a subject's folder, as examples/fit_grab.py takes it")
    parser.add_argument("--body", help="the body model of --data")
    args = read_options(parser)
    body = xa.load_body(args.body) if args.body else xa.synthetic_body(args.cache_dir)
    if args.data:
        capture = xa.load_data(args.data, body=body)
    else:
        capture = xa.synthetic_capture(args.cache_dir, body=body)
    shown = capture.test[spread(capture.test, 4)]

    def run(name: str, seed: int) -> dict[str, Any]:
        model, spent = learn(
            name, capture, args.minutes, seed, small=args.quick, cache=args.cache_dir
        )
        return {
            **spent,
            "mesh_ms": measure_speed(model, shown),
            **score(model, capture.test, args.eval_frames),
        }

    fill(
        every(name=args.only or NAMES, seed=range(args.seeds)),
        run,
        question="held-out accuracy of ours and the baselines at equal time",
        settings={
            "quick": args.quick,
            "minutes": args.minutes,
            "eval_frames": args.eval_frames,
            "data": capture.name,
        },
        file=args.json,
        columns=COLUMNS,
    )


if __name__ == "__main__":
    main()
