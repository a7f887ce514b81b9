"""Learn an avatar of one person from posed meshes, and test it on motion it has not seen.

Without arguments: the bundled body and capture, the quick preset, ten minutes on two CPU cores.

    python examples/fit_grab.py
    python examples/fit_grab.py --model-dir MODELS --data GRAB_SUBJECT --out out/s1
    python examples/fit_grab.py --resume        # after Ctrl-C, or to raise --steps

`--data` takes a folder with train/*.npz and test/*.npz (AMASS "SMPL-X G" or GRAB), a subject's
own folder of such files, the folders that X-Avatar's preparation makes, or meshes with
parameters. SMPL-X itself is licensed: get it from https://smpl-x.is.tue.mpg.de and name its
folder by --model-dir (MODELS/smplx/SMPLX_NEUTRAL.npz), or one file by --body.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

import xavatar_jax as xa
from xavatar_jax.avatar import Fit
from xavatar_jax.datasets import find_gender
from xavatar_jax.meshing import Mesh
from xavatar_jax.render import save_png, save_webp_animation
from xavatar_jax.report import (
    animation,
    loss_curves,
    metrics_record,
    metrics_table,
    preview,
    write_json,
)
from xavatar_jax.training import PRESETS, Interrupted, TrainingError


@dataclass
class Options:
    """Learn an avatar from posed meshes with SMPL-X parameters, and evaluate it."""

    out: Path = Path("out/fit_grab")
    """Where to write."""
    preset: Literal["quick", "paper"] = "quick"
    """quick: minutes on a CPU. paper: the paper's networks and schedule, for a GPU."""
    steps: int | None = None
    """Training steps, in place of the preset's."""
    minutes: float | None = None
    """Stop training so many minutes after the call of fit, whatever the steps."""
    seed: int = 0
    train_frames: int | None = None
    """Frames to learn from, chosen for their variety (0: all)."""
    eval_frames: str = "24"
    """Held-out frames to evaluate, spread over the sequences: a number or "all"."""
    prefit_steps: int | None = None
    """Steps that fit the first fields to the body's mean shape."""
    resume: bool = False
    """Go on from checkpoint.npz in the folder of --out, if there is one."""
    cache_dir: Path | None = None
    """In place of the user's cache folder."""
    data: Path | None = None
    """A capture; default: the bundled one."""
    test: tuple[str, ...] = ()
    """Sequences to hold out, where the data are not split already."""
    model_dir: Path | None = None
    """Folder of body models, as smplx.create wants it."""
    body: Path | None = None
    """One body model file."""
    gender: Literal["neutral", "female", "male"] | None = None
    """In place of the gender that the data name."""
    quiet: bool = False
    """No progress bars, no table."""


def load(options: Options):
    """The body and the capture that the options ask for."""
    verbose = not options.quiet
    if options.body is not None:
        body = xa.load_body(options.body, gender=options.gender or "neutral")
    elif options.model_dir is not None:
        gender = options.gender or (find_gender(options.data) if options.data else None)
        body = xa.load_body(options.model_dir, gender=gender or "neutral")
    else:
        if verbose:
            print("bundled body (made on first use, about a minute) ...", flush=True)
        body = xa.synthetic_body(options.cache_dir)
    if options.data is None:
        return xa.synthetic_capture(options.cache_dir, body=body, verbose=verbose)
    return xa.load_data(
        options.data,
        body,
        gender=options.gender,
        test=options.test or None,
        split_seed=options.seed,
        verbose=verbose,
    )


def configure(options: Options) -> xa.FitConfig:
    """The preset with what the options change."""
    config = replace(PRESETS[options.preset](), seed=options.seed, minutes=options.minutes)
    for name in ("steps", "train_frames", "prefit_steps"):
        value = getattr(options, name)
        if value is not None:
            config = replace(config, **{name: value})
    return config


def main(options: Options) -> None:
    started = time.perf_counter()
    verbose = not options.quiet
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    count = None if options.eval_frames == "all" else int(options.eval_frames)
    capture = load(options)
    body = capture.body
    loaded = time.perf_counter()
    if verbose:
        print(
            f"{capture.name}: {len(capture.train)} training and {len(capture.test)} held-out "
            f"frames, {body.num_vertices} vertices, {body.source.describe()}",
            flush=True,
        )
    result = xa.fit(
        capture.train,
        configure(options),
        cache=options.cache_dir,
        verbose=verbose,
        checkpoint=out / "checkpoint.npz",
        resume=options.resume,
        log=out / "log.jsonl",
    )
    avatar, history = result
    avatar.save(out / "avatar.npz")
    fitted = time.perf_counter()
    # The held-out frames are read from here on, and nowhere before.
    evaluation = xa.evaluate(
        avatar, capture.test, learned_from=result.frames, num_frames=count, verbose=verbose
    )
    # Step 0 is only a reference: a quarter of the frames are enough for it.
    few = max(len(evaluation.per_frame) // 4, 1)
    before = xa.evaluate(result.before, capture.test, num_frames=few, verbose=verbose)
    evaluated = time.perf_counter()
    written = [out / "avatar.npz", out / "metrics.json", *write_meshes(avatar, capture.test, out)]
    names = list(capture.test.sequences)
    sequence = capture.test.sequences[names[0]]
    save_png(out / "preview.png", preview(avatar, capture.test[len(capture.test) // 2]))
    save_webp_animation(animation(avatar, sequence), out / "animation.webp", fps=10)
    written += [out / "preview.png", out / "animation.webp"]
    if history.steps:
        save_png(out / "losses.png", loss_curves(history))
        written.append(out / "losses.png")
    written += [out / "checkpoint.npz", out / "log.jsonl"]
    finished = time.perf_counter()
    stages = history.seconds
    seconds = {
        "data": loaded - started + sum(stages.get(k, 0) for k in ("settle", "labels", "roots")),
        "prefit": stages["prefit"],
        "compile": stages.get("compile", 0.0),
        "train": sum(stages.get(k, 0) for k in ("train", "validation", "checkpoint")),
        "evaluate": evaluated - fitted,
        "pictures": finished - evaluated,
        "total": finished - started,
    }
    record = metrics_record(
        evaluation,
        before,
        avatar,
        seconds,
        stages={name: round(value, 2) for name, value in stages.items()},
        training=training_record(result),
        data=capture.name,
        notices=list(capture.notices),
    )
    write_json(out / "metrics.json", record)
    if verbose:
        print(metrics_table(evaluation, before))
        print("seconds: " + ", ".join(f"{k} {v:.0f}" for k, v in seconds.items()))
        print("written:")
        for path in written:
            print(f"  {path}")


def training_record(result: Fit) -> dict[str, Any]:
    """How training ended, for the metrics."""
    history = result.history
    return {
        "steps_done": history.steps_done,
        "best_step": history.best_step,
        "stopped": history.stopped,
        "frames": len(result.frames),
        "validation": history.validation[-1] if history.validation else None,
    }


def write_meshes(avatar: xa.Avatar, test: xa.Frames, out: Path) -> list[Path]:
    """One posed mesh of each held-out sequence beside its ground truth, as PLY."""
    written = []
    for name, frames in test.sequences.items():
        frame = frames[len(frames) // 2]
        for mesh, kind in (
            (avatar.mesh(frame.params), "avatar"),
            (Mesh(np.asarray(frame.vertices), np.asarray(frame.faces)), "truth"),
        ):
            path = out / f"{name}_{kind}.ply"
            xa.write_ply(path, mesh)
            written.append(path)
    return written


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except Interrupted as stop:
        print(f"\n{stop} On the command line that is: the same command with --resume.")
        sys.exit(128 + stop.signal)
    except KeyboardInterrupt:
        print("\nstopped before or after training: nothing more was saved.")
        sys.exit(130)
    except (FileNotFoundError, TrainingError, ValueError) as error:
        sys.exit(f"error: {error}")
