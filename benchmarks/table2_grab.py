"""X-Avatar's comparison on GRAB: this library, SNARF and SCANimate at equal time.

Question: how close are the avatars of each method to meshes of held-out motion, after the same
training time?

    python benchmarks/table2_grab.py [--quick] [--json FILE] [--data FOLDER --body FILE]

The data are the bundled capture, or a subject of GRAB if given. SNARF and SCANimate use a body-only
skeleton, as in the paper (Table 2). `template weights` is our method with the fixed skinning
weights of the body. All methods start from fields fitted to the body's mean shape, and the time
includes this fit (except for `paper` and the paper-sized baselines, which `--only` adds). Rows are
written as runs finish, and the same command continues a stopped table.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from methods import METHODS, learn
from resumable import add_options, every, fill, read_options, score

import xavatar_jax as xa
from xavatar_jax.avatar import Drivable
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


def measure_speed(model: Drivable, frames: xa.Frames) -> float:
    """Milliseconds per mesh in a new pose, once the canonical surface is extracted."""
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
    parser.add_argument("--data", help="folder of a subject, as for examples/fit_grab.py")
    parser.add_argument("--body", help="body model of --data")
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
        question="held-out accuracy of our method and the baselines at equal time",
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
