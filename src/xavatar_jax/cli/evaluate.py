"""`xavatar evaluate`: an avatar against meshes that it has not seen."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

import xavatar_jax as xa

from .inputs import count_of, read_avatar_body, read_capture
from .options import Count, File, Flag, Folder, Gender, Target, Truth, Words, arg
from .outputs import check_file, written


@dataclass
class Options:
    """Compare an avatar with the held-out meshes of a capture: a table, and metrics.json.

    The figures are explained in docs/benchmarks.md.
    """

    avatar: Positional[Path]
    """Avatar file, as `xavatar fit` writes it."""
    out: Target = Path("out/evaluate/metrics.json")
    """Where to write the figures, as JSON."""
    data: Folder = None
    """A capture; without it the bundled one."""
    test: Words = ()
    """Its sequences to evaluate on, where it is not split already."""
    flat_hand_mean: Truth = None
    """Of meshes with parameters beside them. False: their hands are relative to the mean hand."""
    eval_frames: Annotated[str, arg(metavar="N|all")] = "24"
    """Held-out frames to evaluate, spread over the sequences."""
    mode: Literal["fast", "full"] = "fast"
    """fast: skin the canonical surface. full: extract every frame's own; slow."""
    body: File = None
    """The body model, if it is not where the avatar was learned ("bundled": our own)."""
    gender: Gender = None
    """In place of the gender that the data name."""
    seed: Count = None
    """Of the points that are compared, and of the split; without it that of the avatar's run."""
    quiet: Flag = False
    """No progress bars, no table."""


def run(options: Options) -> None:
    """Evaluate, write the figures, print the table."""
    from ..avatar import load_avatar_config
    from ..report import metrics_record, metrics_table, write_json

    started = time.perf_counter()
    count = count_of(options.eval_frames)
    check_file(options.out)
    seed = load_avatar_config(options.avatar).seed if options.seed is None else options.seed
    body = read_avatar_body(options.avatar, options.body)
    capture = read_capture(
        options.data,
        body,
        gender=options.gender,
        test=options.test,
        seed=seed,
        flat_hand_mean=options.flat_hand_mean,
        verbose=not options.quiet,
    )
    # A capture may have the person's own template: then that is the body that was learned on.
    avatar = xa.load_avatar(options.avatar, body=capture.body)
    evaluation = xa.evaluate(
        avatar,
        capture.test,
        num_frames=count,
        mode=options.mode,
        seed=seed,
        verbose=not options.quiet,
    )
    seconds = {"total": time.perf_counter() - started}
    record = metrics_record(
        evaluation,
        None,
        avatar,
        seconds,
        data=capture.name,
        mode=options.mode,
        notices=list(capture.notices),
    )
    write_json(options.out, record)
    if not options.quiet:
        print(metrics_table(evaluation))
    written(options.out, quiet=options.quiet)
