"""`xavatar evaluate`: an avatar compared with held-out meshes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import OmitArgPrefixes, Positional

import xavatar_jax as xa

from .files import check_output, count_of, read_avatar_body, read_capture, written
from .options import Count, Data, File, Flag, Target


@dataclass
class Options:
    """Compare an avatar with the held-out meshes of a capture: a table, and metrics.json.

    docs/benchmarks.md explains the metrics.
    """

    avatar: Positional[Path]
    """Avatar file written by `xavatar fit`."""
    out: Target = Path("out/evaluate/metrics.json")
    """Output file for the metrics, in JSON."""
    mode: Literal["fast", "full"] = "fast"
    """fast: skin the canonical surface. full: extract the surface of each frame; slow."""
    body: File = None
    """Body model, if it is not where the avatar was trained ("bundled": the bundled body)."""
    seed: Count = None
    """Random seed of the compared points and of the split (default: that of the avatar's run)."""
    quiet: Flag = False
    """No progress bars, no table."""
    capture: OmitArgPrefixes[Data] = field(default_factory=Data)


def run(options: Options) -> None:
    """Evaluate, write the metrics, print the table."""
    from ..avatar import load_avatar_header
    from ..report import metrics_record, metrics_table, write_json

    started = time.perf_counter()
    count = count_of(options.capture.eval_frames)
    check_output(options.out)
    seed = options.seed
    if seed is None:
        seed = load_avatar_header(options.avatar).options.get("seed", 0)
    body = read_avatar_body(options.avatar, options.body)
    capture = read_capture(options.capture, body, seed=seed, verbose=not options.quiet)
    # A capture may come with the person's own template, on which the avatar was then trained.
    avatar = xa.load_avatar(options.avatar, body=capture.body)
    evaluation = xa.evaluate(
        avatar,
        capture.test,
        num_frames=count,
        mode=options.mode,
        seed=seed,
        verbose=not options.quiet,
    )
    record = metrics_record(
        evaluation,
        None,
        avatar,
        {"total": time.perf_counter() - started},
        data=capture.name,
        mode=options.mode,
        notices=list(capture.notices),
    )
    write_json(options.out, record)
    if not options.quiet:
        print(metrics_table(evaluation))
    written(options.out, quiet=options.quiet)
