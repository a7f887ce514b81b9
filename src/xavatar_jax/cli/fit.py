"""`xavatar fit`: learn an avatar, test it on motion it has not seen, and show both."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from tyro.conf import Suppress

import xavatar_jax as xa

from . import options as shared
from .inputs import count_of, read_body, read_capture
from .options import Count, File, Flag, Folder, Gender, Number, Target, Truth, Words
from .outputs import check_folder

if TYPE_CHECKING:
    from ..avatar import Avatar, Fit
    from ..datasets import Capture
    from ..frames import Frames
    from ..training import FitConfig

# Entries of the config that have an option of their own.
_SHORT = ("steps", "minutes", "seed", "train_frames", "prefit_steps")


@dataclass
class Options:
    """Learn an avatar from posed meshes with SMPL-X parameters, and test it on held-out frames.

    Without options: the bundled body and capture, in minutes on two CPU cores.

    After Ctrl-C the same command with --resume goes on.

    Entries of the preset's config are options too, as --config.losses.surface 50.
    --config.help lists them.
    """

    out: Target = Path("out/fit_grab")
    """Folder to write to."""
    preset: Literal["quick", "paper"] = "quick"
    """quick: minutes on a CPU. paper: the paper's networks and schedule, for a GPU."""
    steps: Count = None
    """Training steps, in place of the preset's."""
    minutes: Number = None
    """Stop training so many minutes after it was begun, whatever the steps."""
    seed: Annotated[int, shared.arg(metavar="N")] = 0
    """Of every draw."""
    train_frames: Count = None
    """Frames to learn from, chosen for their variety (0: all)."""
    eval_frames: Annotated[str, shared.arg(metavar="N|all")] = "24"
    """Held-out frames to evaluate, spread over the sequences."""
    prefit_steps: Count = None
    """Steps that fit the first fields to the body's mean shape."""
    resume: Flag = False
    """Go on from checkpoint.npz in the folder of --out, if there is one."""
    cache_dir: Folder = None
    """In place of the user's cache folder."""
    data: Folder = None
    """A capture; without it the bundled one."""
    test: Words = ()
    """Sequences to hold out, where the data are not split already."""
    flat_hand_mean: Truth = None
    """Of meshes with parameters beside them. False: their hands are relative to the mean hand."""
    model_dir: Folder = None
    """Body models, in the layout of smplx.create. With --data also SMPLX_MODEL_DIR is looked at."""
    body: File = None
    """One body model file."""
    gender: Gender = None
    """In place of the gender that the data name."""
    quiet: Flag = False
    """No progress bars, no table."""
    config: Suppress[Any] = None
    # A `FitConfig` in place of the preset's, as --config.NAME makes it.


def parse(arguments: Sequence[str], prog: str, description: str | None = None) -> Options:
    """Options from a command line, `--config.NAME` among them."""
    own, entries = split_entries(arguments)
    options = shared.parse(Options, own, prog, description)
    if entries:
        options.config = _changed(options.preset, entries, prog)
    return options


def split_entries(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """A command line without its `--config.NAME` options, and these with their values."""
    own: list[str] = []
    entries: list[str] = []
    current = own
    for word in arguments:
        if word.startswith("--"):
            current = entries if word.startswith("--config.") else own
        current.append(word)
    return own, entries


def _changed(preset: str, entries: list[str], prog: str) -> FitConfig:
    """The preset's config with entries replaced."""
    from ..training import PRESETS, FitConfig

    for word in entries:
        name = word.removeprefix("--config.").partition("=")[0].replace("-", "_")
        if name in _SHORT or name == "preset":
            option = f"--{name.replace('_', '-')}"
            raise ValueError(f"{word}: this entry has an option of its own, {option}")
    config = PRESETS[preset]()
    hints = get_type_hints(FitConfig)
    open_fields = [
        (f.name, hints[f.name], field(default=getattr(config, f.name)))
        for f in fields(FitConfig)
        if f.name not in (*_SHORT, "preset")
    ]
    entry_kind: Any = make_dataclass("Entries", open_fields, frozen=True)
    kind: Any = make_dataclass(
        "Config", [("config", entry_kind, field(default_factory=entry_kind))]
    )
    words = ["--help" if word == "--config.help" else word for word in entries]
    about = f"Entries of the config of preset {preset}, with its values."
    chosen = shared.parse(kind, words, f"{prog} --preset {preset}", about).config
    return replace(config, **{f.name: getattr(chosen, f.name) for f in fields(chosen)})


def configure(options: Options) -> FitConfig:
    """The preset with what the options change."""
    from ..training import PRESETS

    config = PRESETS[options.preset]() if options.config is None else options.config
    config = replace(config, seed=options.seed, minutes=options.minutes)
    given = {name: getattr(options, name) for name in ("steps", "train_frames", "prefit_steps")}
    return replace(config, **{name: value for name, value in given.items() if value is not None})


def load(options: Options) -> Capture:
    """The capture that the options ask for, with its body."""
    from ..datasets import find_gender

    verbose = not options.quiet
    models = options.model_dir
    if models is None and options.data is not None and "SMPLX_MODEL_DIR" in os.environ:
        models = Path(os.environ["SMPLX_MODEL_DIR"])
    if options.body is not None:
        body = read_body(options.body, options.gender)
    elif models is not None:
        gender = options.gender or (find_gender(options.data) if options.data else None)
        body = read_body(models, gender)
    else:
        if verbose:
            print("bundled body (made on first use, about a minute) ...", flush=True)
        body = xa.synthetic_body(options.cache_dir)
    return read_capture(
        options.data,
        body,
        gender=options.gender,
        test=options.test,
        seed=options.seed,
        flat_hand_mean=options.flat_hand_mean,
        cache=options.cache_dir,
        verbose=verbose,
    )


def run(options: Options) -> None:
    """Fit, evaluate, and write avatar, metrics, meshes and pictures."""
    from .. import report
    from ..meshing import EmptyLevelSetError
    from ..render import save_png, save_webp_animation

    started = time.perf_counter()
    verbose = not options.quiet
    out = options.out
    count = count_of(options.eval_frames)
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
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
    try:
        evaluation = xa.evaluate(
            avatar, capture.test, learned_from=result.frames, num_frames=count, verbose=verbose
        )
        # Step 0 is only a reference: a quarter of the frames are enough for it.
        few = max(len(evaluation.per_frame) // 4, 1)
        before = xa.evaluate(result.before, capture.test, num_frames=few, verbose=verbose)
    except EmptyLevelSetError as error:
        raise EmptyLevelSetError(
            f"no surface to evaluate, after {history.steps_done} steps or at step 0: {error} The "
            f"avatar and its checkpoint are in {out}; take more --steps (with --resume) or more "
            "--prefit-steps."
        ) from error
    evaluated = time.perf_counter()
    written = [out / "avatar.npz", out / "metrics.json", *write_meshes(avatar, capture.test, out)]
    sequence = next(iter(capture.test.sequences.values()))
    save_png(out / "preview.png", report.preview(avatar, capture.test[len(capture.test) // 2]))
    save_webp_animation(report.animation(avatar, sequence), out / "animation.webp", fps=10)
    written += [out / "preview.png", out / "animation.webp"]
    if history.steps:
        save_png(out / "losses.png", report.loss_curves(history))
        written.append(out / "losses.png")
    written += [out / "checkpoint.npz", out / "log.jsonl"]
    finished = time.perf_counter()
    stages = history.seconds
    seconds = {
        "data": loaded - started + sum(stages.get(k, 0) for k in ("settle", "labels", "roots")),
        "prefit": stages["prefit"],
        "compile": stages.get("compile", 0.0),
        "train": sum(stages.get(k, 0) for k in ("train", "validation", "checkpoint", "redraw")),
        "evaluate": evaluated - fitted,
        "pictures": finished - evaluated,
        "total": finished - started,
    }
    record = report.metrics_record(
        evaluation,
        before,
        avatar,
        seconds,
        stages={name: round(value, 2) for name, value in stages.items()},
        training=training_record(result),
        data=capture.name,
        notices=[*capture.notices, *history.notices],
    )
    report.write_json(out / "metrics.json", record)
    if verbose:
        print(report.metrics_table(evaluation, before))
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


def write_meshes(avatar: Avatar, test: Frames, out: Path) -> list[Path]:
    """One posed mesh of each held-out sequence beside its ground truth, as PLY."""
    import numpy as np

    from ..meshing import Mesh

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
