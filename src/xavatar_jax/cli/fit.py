"""`xavatar fit`: train an avatar, evaluate it on held-out frames, and draw both."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from tyro.conf import OmitArgPrefixes, Suppress

import xavatar_jax as xa

from . import options as shared
from .files import check_output, count_of, read_body, read_capture
from .options import Count, File, Flag, Folder, Number, Target

if TYPE_CHECKING:
    from ..avatar import Drivable
    from ..datasets import Capture
    from ..frames import Frames
    from ..methods import Fit

_LOADING = ("weights", "labels", "roots", "data")
_TRAINING = ("train", "validation", "checkpoint", "polish", "guide", "redraw", "canonical")
# Entries of the config with a short option.
_SHORT = ("steps", "minutes", "seed", "train_frames", "prefit_steps")


@dataclass
class Options:
    """Fit an avatar to posed meshes with SMPL-X parameters and evaluate it on held-out frames.

    Without options: the bundled body and capture, in minutes on two CPU cores.

    After Ctrl-C, the same command with --resume continues the run.

    Every entry of the preset's config is also an option, such as --config.losses.surface 50.
    --config.help lists them.
    """

    out: Target = Path("out/fit_grab")
    """Output folder."""
    method: Literal["xavatar", "snarf", "scanimate"] = "xavatar"
    """Method to train. snarf and scanimate are baselines without fingers and expression."""
    preset: Literal["quick", "paper"] = "quick"
    """quick: minutes on a CPU. paper: the paper's networks and schedule, for a GPU."""
    steps: Count = None
    """Number of training steps. Not for scanimate, whose three stages are set by --config."""
    minutes: Number = None
    """Time budget of training in minutes, counted from its start."""
    seed: Annotated[int, shared.arg(metavar="N")] = 0
    """Random seed."""
    train_frames: Count = None
    """Number of training frames, chosen for their variety (0: all)."""
    prefit_steps: Count = None
    """Steps that fit the model to the body's mean shape before training. Not for scanimate."""
    resume: Flag = False
    """Continue from checkpoint.npz in the output folder, if it exists."""
    cache_dir: Folder = None
    """Cache folder (default: the user's)."""
    model_dir: Folder = None
    """Folder of body models, as for smplx.create (default with --data: SMPLX_MODEL_DIR)."""
    body: File = None
    """Body model file."""
    quiet: Flag = False
    """No progress bars, no table."""
    capture: OmitArgPrefixes[shared.Data] = field(default_factory=shared.Data)
    config: Suppress[Any] = None
    # The preset's config with the --config.NAME options applied.


def parse(arguments: Sequence[str], prog: str, description: str | None = None) -> Options:
    """Parse a command line, including its `--config.NAME` options."""
    own, entries = split_entries(arguments)
    options = shared.parse(Options, own, prog, description)
    if entries:
        options.config = _changed(options.method, options.preset, entries, prog)
    return options


def split_entries(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into its own words and the `--config.NAME` options with values."""
    own: list[str] = []
    entries: list[str] = []
    current = own
    for word in arguments:
        if word.startswith("--"):
            current = entries if word.startswith("--config.") else own
        current.append(word)
    return own, entries


def _changed(method: str, preset: str, entries: list[str], prog: str) -> Any:
    """The preset's config with the given entries replaced."""
    from ..methods import METHODS

    for word in entries:
        name = word.removeprefix("--config.").partition("=")[0].replace("-", "_")
        if name in _SHORT or name == "preset":
            option = f"--{name.replace('_', '-')}"
            raise ValueError(f"{word}: use the option {option} for this entry")
    config = METHODS[method].presets[preset]()
    hints = get_type_hints(type(config))
    open_fields = [
        (f.name, hints[f.name], field(default=getattr(config, f.name)))
        for f in fields(config)
        if f.name not in (*_SHORT, "preset")
    ]
    entry_kind: Any = make_dataclass("Entries", open_fields, frozen=True)
    kind: Any = make_dataclass(
        "Config", [("config", entry_kind, field(default_factory=entry_kind))]
    )
    words = ["--help" if word == "--config.help" else word for word in entries]
    about = f"Config entries of {method}, preset {preset}, with their values."
    chosen = shared.parse(kind, words, f"{prog} --method {method} --preset {preset}", about).config
    return replace(config, **{f.name: getattr(chosen, f.name) for f in fields(chosen)})


def configure(options: Options) -> Any:
    """The config of the method and preset with the options applied.

    **Raises:** `ValueError` for an option that the method does not have.
    """
    from ..methods import METHODS

    config = options.config
    if config is None:
        config = METHODS[options.method].presets[options.preset]()
    known = {f.name for f in fields(config)}
    given = {name: getattr(options, name) for name in _SHORT}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in known:
            raise ValueError(
                f"--{name.replace('_', '-')} is not an option of {options.method}; "
                f"xavatar fit --method {options.method} --config.help lists its entries"
            )
    return replace(config, **given)


def load(options: Options) -> Capture:
    """The capture that the options name, with its body."""
    from ..datasets import find_gender

    models, data = options.model_dir, options.capture.data
    if models is None and data is not None and "SMPLX_MODEL_DIR" in os.environ:
        models = Path(os.environ["SMPLX_MODEL_DIR"])
    if options.body is not None:
        body = read_body(options.body, options.capture.gender)
    elif models is not None:
        gender = options.capture.gender or (find_gender(data) if data else None)
        body = read_body(models, gender)
    else:
        if not options.quiet:
            print("bundled body (generated on first use, about a minute) ...", flush=True)
        body = xa.synthetic_body(options.cache_dir)
    return read_capture(
        options.capture,
        body,
        seed=options.seed,
        verbose=not options.quiet,
        cache=options.cache_dir,
    )


def run(options: Options) -> None:
    """Fit, evaluate, and write avatar, metrics, meshes and pictures."""
    from .. import report
    from ..meshing import EmptyLevelSetError
    from ..methods import METHODS
    from ..render import save_png, save_webp_animation

    started = time.perf_counter()
    verbose = not options.quiet
    out = options.out
    count = count_of(options.capture.eval_frames)
    check_output(out, "folder")
    config = configure(options)
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
    result = METHODS[options.method].fit(
        capture.train,
        config,
        cache=options.cache_dir,
        verbose=verbose,
        checkpoint=out / "checkpoint.npz",
        resume=options.resume,
        log=out / "log.jsonl",
    )
    avatar, history = result
    avatar.save(out / "avatar.npz")
    fitted = time.perf_counter()
    # No held-out frame is read before this point.
    try:
        evaluation = xa.evaluate(
            avatar, capture.test, learned_from=result.frames, num_frames=count, verbose=verbose
        )
        before = None
        if result.before is not None:
            # A quarter of the frames is enough for step 0, which is only a reference.
            few = max(len(evaluation.per_frame) // 4, 1)
            before = xa.evaluate(result.before, capture.test, num_frames=few, verbose=verbose)
    except EmptyLevelSetError as error:
        raise EmptyLevelSetError(
            f"no surface to evaluate, after {history.steps_done} steps or at step 0: {error} The "
            f"avatar and its checkpoint are in {out}; increase --steps (with --resume) or "
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
        "data": loaded - started + sum(stages.get(k, 0) for k in _LOADING),
        "prefit": stages.get("prefit", 0.0),
        "compile": stages.get("compile", 0.0),
        "train": sum(stages.get(k, 0) for k in _TRAINING),
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
        preset=options.preset,
        seed=options.seed,
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
    """How training ended, for metrics.json."""
    history = result.history
    return {
        "steps_done": history.steps_done,
        "best_step": history.best_step,
        "stopped": history.stopped,
        "frames": len(result.frames),
        "validation": history.validation[-1] if history.validation else None,
    }


def write_meshes(avatar: Drivable, test: Frames, out: Path) -> list[Path]:
    """Write one posed mesh per held-out sequence and its ground truth, as PLY."""
    import numpy as np

    from ..meshing import Mesh

    written = []
    for name, frames in test.sequences.items():
        frame = frames[len(frames) // 2]
        for mesh, kind in (
            (avatar.surface(frame.params), "avatar"),
            (Mesh(np.asarray(frame.vertices), np.asarray(frame.faces)), "truth"),
        ):
            path = out / f"{name}_{kind}.ply"
            xa.write_ply(path, mesh)
            written.append(path)
    return written
