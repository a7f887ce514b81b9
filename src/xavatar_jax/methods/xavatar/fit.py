"""From frames to an avatar in one call."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ...avatar import Avatar, SearchSpec
from ...body import BodyModel, check_params
from ...correspondence import start_table
from ...fields import (
    AvatarModel,
    PartGrids,
    TabulatedSkinning,
    grids_for_search,
    learned_leaves,
    mean_shape_model,
)
from ...files import load_header, unflatten_named
from ...frames import Frames, known_body, nearest_part_labels
from ...learning import (
    Callback,
    Devices,
    History,
    Identity,
    Interrupted,
    JsonLines,
    Keeper,
    Schedule,
    Terms,
    TrainingError,
    Validation,
    as_arrays,
    check_minutes,
    load_checkpoint,
    notify,
    progress,
    share_work,
    train,
)
from ...sampling import VolumePoints, volume_points
from ..observations import (
    FrameCheck,
    check_expression,
    check_found,
    choose_frames,
    frame_digest,
    frames_digest,
    subject_betas,
    with_one_shape,
)
from ..result import Fit
from .config import FitConfig, quick
from .roots import FrameData, RootCache, frame_data, search_roots, tabulated
from .stages import training_stages, validation_loss
from .start import starting_models
from .upkeep import GuideRenewal, Redraw, RootPolish

# What a resumed run may change: how long it is, and how large its steps are.
_FREE = (
    "steps", "minutes", "report_every", "checkpoint_every", "validation.patience",
    "validation.every", "validation.gain", "optimiser.learning_rate", "optimiser.skinning_rate",
    "optimiser.clip",
)  # fmt: skip


def fit(
    frames: Frames,
    config: FitConfig | None = None,
    *,
    body: BodyModel | None = None,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
    callback: Callback | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    log: str | os.PathLike[str] | None = None,
    devices: Sequence[Any] | None = None,
    model: AvatarModel | None = None,
    terms: Terms | None = None,
) -> Fit:
    """Learn an avatar of the person in `frames` with X-Avatar (Shen, Guo et al., CVPR 2023).

    `avatar, history = fit(frames)` uses the preset `quick`.

    - `config`: `quick()`, `paper()`, or either with entries replaced.
    - `body`: the model that the parameters are for. Frames from our loaders know it.
    - `cache`: overrides the folder in which the fit to the body's mean shape is kept.
    - `callback`: `callback(step, model, terms)`, called every `config.report_every` steps.
    - `checkpoint`: a file that holds the whole run, written regularly, at the end, and when
      training is stopped. `resume=True` continues from it with the numbers of an uninterrupted
      run on the same machine.
    - `log`: a file that gets one JSON object a line.
    - `devices`: share each step (default: all that JAX sees).
    - `model`: starts from this model instead of the config's, in the person's canonical space. Pass
      it again to resume.
    - `terms`: additional loss terms, `{name: (weight, term)}` with `term(model, batch, key)`. Pass
      them again to resume.

    The person's shape is the mean of the frames' betas. The end of each sequence is held out: the
    model that does best there is kept (`config.validation`).

    **Raises:** `ValueError` naming the frame whose parameters or mesh cannot be used, or what
    differs from the run of a checkpoint; `TrainingError` if a loss is not finite, and
    `Interrupted` after Ctrl-C, both with the result so far, a `Fit`, as `error.fitted`.
    **Warns:** `TrainingNotice` naming frames whose mesh and parameters do not match.
    """
    started = time.perf_counter()
    config = quick() if config is None else config
    body = known_body(frames, body)
    check_minutes(config.minutes)
    check_params(body, frames.params, what="frames.params")
    if resume and checkpoint is None:
        raise ValueError("resume=True needs checkpoint=FILE, the file to continue from")
    sharing = _share(config, devices)
    notices: list[str] = []
    betas = subject_betas(frames)
    frames = with_one_shape(frames, betas, notices)
    saved_frames = _frames_of(checkpoint) if resume and checkpoint is not None else 0
    learned, held = choose_frames(
        frames,
        # A resumed run has the frames it began with, whatever its minutes are now.
        train_frames=saved_frames or config.train_frames,
        minutes=None if saved_frames else config.minutes,
        per_minute=config.frames_per_minute,
        held_share=config.validation.share,
        held_frames=config.validation.frames,
        notices=notices,
    )
    chosen = frames[np.concatenate([learned, held])]
    history = History(frames=len(learned), notices=notices)

    spec, initial = config.spec, None
    search = SearchSpec(starts=config.search.starts, grid=config.search.grid)

    def finished(model: AvatarModel, history: History) -> Fit:
        def avatar(model: AvatarModel, steps: int) -> Avatar:
            return Avatar(body, betas, model, spec, search, steps, "xavatar", config.to_dict())

        before = None if initial is None else avatar(initial, 0)
        history.lap("total", started)
        return Fit(avatar(model, history.best_step), history, before, frames[learned])

    redraw = None
    try:
        if model is not None:
            initial = start = model
        else:
            initial, start = starting_models(
                mean_shape_model(spec, body, key=jax.random.key(config.seed), betas=betas),
                config, body, betas,
                seed=config.seed, history=history, cache=cache, verbose=verbose,
            )  # fmt: skip
        geometry = start.geometry.within(frames[learned].params)
        start = eqx.tree_at(lambda m: m.geometry, start, geometry)
        preparation = _Preparation(body, start, betas, config)
        data, keeper = _data_and_keeper(
            preparation, chosen, betas, config, checkpoint, resume, history, sharing, verbose
        )
        saved = None if keeper is None else keeper.saved
        if saved is not None:
            budget = saved.options["steps"], saved.options["minutes"]
            if (config.steps, config.minutes) != budget:  # another budget is another plan
                history.planned = history.landing = 0
        lines = None
        if log is not None and jax.process_index() == 0:
            lines = JsonLines(log, after=history.steps_done or None)
        stages = training_stages(
            body, betas, data,
            search=config.search, losses=config.losses, optimiser=config.optimiser,
            frames=config.frames_per_step, points=config.points_per_step,
            skinning_points=config.skinning_points, skinning_every=config.skinning_every,
            learn_skinning=config.learn_skinning, held=len(held), devices=sharing, extra=terms,
        )  # fmt: skip
        validation = None
        if len(held):
            options = config.validation
            loss = validation_loss(stages, data, start.link, points=options.points, held=len(held))
            validation = Validation(loss, options.every, options.patience, options.gain)
        upkeep, redraw = _upkeep(preparation, frames[learned], config)
        if redraw is not None:
            redraw.begin(0 if saved is None else saved.step)
        deadline = None if config.minutes is None else started + 60 * config.minutes
        schedule = Schedule(
            config.steps, deadline, config.seed, config.report_every, config.checkpoint_every
        )
        done = train(
            start, data, stages, schedule, upkeep=upkeep, validation=validation, history=history,
            keeper=keeper, log=lines, callback=callback, devices=sharing, verbose=verbose,
            options=config.to_dict(),
        )  # fmt: skip
    except (TrainingError, Interrupted) as error:
        error.fitted = finished(error.fitted.model, history)
        raise
    finally:
        if redraw is not None:
            redraw.close()
    return finished(done.model, history)


class _Preparation:
    """Makes training data of frames: labelled points and, if they are cached, their roots."""

    def __init__(self, body: BodyModel, start: AvatarModel, betas: Any, config: FitConfig):
        self.body, self.start = body, start
        self.plan, self.search, self.seed = config.points, config.search, config.seed
        self._betas = betas

    @cached_property
    def grids(self) -> PartGrids:
        """Where the skinning field is tabulated."""
        return grids_for_search(self.start.skinning, self.body, self._betas, self.search.grid)

    @cached_property
    def table(self) -> TabulatedSkinning:
        """The skinning field that training starts from, tabulated."""
        return tabulated(self.start.skinning, self.grids)

    def label(
        self, frames: Frames, places: Any, *, number: int = 0, bar: Any = None, check: Any = None
    ) -> tuple[VolumePoints, list[str]]:
        """Points `(F, N)` of frames without their translation, and a digest of each mesh.

        Draws are keyed by seed, place and round `number`; one mesh is held at a time.
        """
        drawn, digests = [], []
        for k, place in enumerate(places):
            frame = frames[k]
            labels = frame.part_labels
            if labels is None:
                labels = nearest_part_labels(self.body, frame.params, frame.vertices)
            key = (self.seed, int(place), number) if number else (self.seed, int(place))
            parts = self.body.parts.with_labels(labels)
            points = volume_points(frame, parts, self.plan, np.random.default_rng(key))
            shift = np.asarray(frame.params.transl, np.float32)
            drawn.append(points._replace(x_d=points.x_d - shift, part=points.part.astype(np.int8)))
            if check is not None:
                check.add(frame)
                digests.append(frame_digest(frame))
            if bar is not None:
                bar.update(1)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *drawn), digests

    def roots(self, data: FrameData, *, bar: Any = None) -> FrameData:
        """The data with roots, if they are cached, or with a guide, if searches have one."""
        search = self.search
        if search.cached:
            return search_roots(
                self.start.geometry, self.table, data, start_table(self.body, search.starts),
                keep=search.keep, atol=search.atol, max_steps=search.max_steps, bar=bar,
            )  # fmt: skip
        if search.guide_every:
            return self.with_guide(data, self.start)
        return data

    def with_guide(self, data: FrameData, model: AvatarModel) -> FrameData:
        """The data with a guide of this model's skinning field."""
        return GuideRenewal(self.grids, 1)(model, data, 0)

    def redrawn(self, frames: Frames) -> Any:
        """`make(rows, round)` for `Redraw`."""

        def make(rows: Any, number: int) -> FrameData:
            own = frames[rows]
            samples, _ = self.label(own, rows, number=number)
            data = frame_data(self.body, samples, own.params)
            return self.roots(data) if self.search.cached else data

        return make

    def restored(self, saved: dict[str, Any], frames: Frames) -> FrameData:
        """Data as a checkpoint has it."""

        def group(kind: Any, name: str) -> Any:
            prefix = f"{name}."
            own = {n.removeprefix(prefix): v for n, v in saved.items() if n.startswith(prefix)}
            return kind(**own) if own else None

        data = frame_data(self.body, group(VolumePoints, "samples"), frames.params)
        data = replace(data, roots=group(RootCache, "roots"))
        prefix = "guide_source."
        source = {n.removeprefix(prefix): v for n, v in saved.items() if n.startswith(prefix)}
        if not source:
            return data
        own = eqx.filter(self.start.skinning, learned_leaves(self.start.skinning))
        leaves = unflatten_named(own, source, source="checkpoint")
        skinning = eqx.combine(leaves, self.start.skinning)
        model = eqx.tree_at(lambda m: m.skinning, self.start, skinning)
        return self.with_guide(data, model)


def _data_and_keeper(
    preparation: _Preparation,
    frames: Frames,
    betas: Any,
    config: FitConfig,
    checkpoint: str | os.PathLike[str] | None,
    resume: bool,
    history: History,
    devices: Devices,
    verbose: bool,
) -> tuple[FrameData, Keeper | None]:
    """The data of a run, drawn or from its checkpoint, and what writes its checkpoints."""
    notices = history.notices
    if resume and checkpoint is not None and not Path(checkpoint).exists():
        notify(
            f"no checkpoint at {os.fspath(checkpoint)}: the run starts at step 0.",
            notices,
            stacklevel=3,
        )
        resume = False
    body, clock = preparation.body, time.perf_counter()

    def keeper(digests: Sequence[str], saved: Any = None) -> Keeper | None:
        if checkpoint is None:
            return None
        parts = {
            "body": body.source.checksum, "frames": frames_digest(frames.params, betas, digests)
        }  # fmt: skip
        identity = Identity(parts, config.to_dict(), _FREE)
        if saved is not None:
            saved = load_checkpoint(checkpoint, identity, devices, notices)
        return Keeper(Path(checkpoint), identity, saved, _Stored.of)

    if resume:
        with progress("frames", len(frames), verbose=verbose, unit="frame") as bar:
            digests = []
            for frame in frames:
                digests.append(frame_digest(frame))
                bar.update(1)
        done = keeper(digests, saved=True)
        assert done is not None
        assert done.saved is not None
        before = done.saved.history()
        notices = [said for said in notices if said not in before.notices]
        vars(history).update({**vars(before), "notices": before.notices + notices})
        data = preparation.restored(as_arrays(done.saved.part("data")), frames)
        history.lap("labels", clock)
        return data, done
    check_expression(frames.params, notices)
    check = FrameCheck(body)
    with progress("points", len(frames), verbose=verbose, unit="frame") as bar:
        samples, digests = preparation.label(frames, range(len(frames)), bar=bar, check=check)
    check.report(notices)
    data = frame_data(body, samples, frames.params)
    clock = history.lap("labels", clock)
    with progress("roots", len(frames), verbose=verbose, unit="frame") as bar:
        data = preparation.roots(data, bar=bar)
    if data.roots is not None:
        found, points = np.asarray(data.roots.found), data.samples.x_d.shape[1]
        history.found = float(found.mean() / points)
        check_found(frames.sources, found, points, notices)
    history.lap("roots", clock)
    return data, keeper(digests)


class _Stored(NamedTuple):
    """What a checkpoint keeps of the data: transforms and parameters come from the frames."""

    samples: VolumePoints
    roots: RootCache | None
    guide_source: Any

    @classmethod
    def of(cls, data: FrameData) -> _Stored:
        return cls(data.samples, data.roots, data.guide_source)


def _upkeep(
    preparation: _Preparation, learned: Frames, config: FitConfig
) -> tuple[list[Any], Redraw | None]:
    upkeep, redraw, search = [], None, config.search
    if config.redraw_every:
        redraw = Redraw(
            preparation.redrawn(learned), preparation.grids,
            every=config.redraw_every, frames=config.redraw_frames, learned=len(learned),
            rounds=(config.steps - 1) // config.redraw_every,
        )  # fmt: skip
        upkeep.append(redraw)
    if config.learn_skinning and search.cached:
        upkeep.append(RootPolish(preparation.grids, config.polish_every, config.polish_frames))
    if config.learn_skinning and not search.cached and search.guide_every:
        upkeep.append(GuideRenewal(preparation.grids, search.guide_every))
    return upkeep, redraw


def _share(config: FitConfig, devices: Sequence[Any] | None) -> Devices:
    points = {"points_per_step": config.points_per_step}
    if config.search.cached:
        points["skinning_points"] = config.skinning_points
    return share_work(config.frames_per_step, points, devices)


def _frames_of(checkpoint: str | os.PathLike[str]) -> int:
    """How many frames the run of a checkpoint learned from, or 0 if there is no checkpoint."""
    if not Path(checkpoint).exists():
        return 0
    return load_header(checkpoint).get("history", {}).get("frames", 0)
