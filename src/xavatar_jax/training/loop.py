"""From frames to a pool, from a pool to fields."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from ..body import BodyModel, check_params, with_betas
from ..frames import Frames
from ..sampling import varied_frames
from .budget import as_begun, check_minutes, frames_in_budget, say_fewer_frames
from .check import check_expression, check_found, notify
from .checkpoint import Keeper, load_checkpoint, run_identity
from .config import FitConfig, check_start
from .devices import ONE_DEVICE, Devices, share_work
from .history import History
from .log import JsonLines
from .model import AvatarFields
from .objective import ExtraTerms, check_terms
from .pool import FramePool, centred, find_roots, label_frames
from .prefit import initial_fields
from .progress import progress
from .redraw import Redraw
from .run import Callback, Fitted, Run
from .settle import settle_on_person
from .validation import split_validation

_SAME_BETAS = 1e-3  # what a file rounds


def fit_fields(
    body: BodyModel,
    frames: Frames,
    betas: Any,
    config: FitConfig,
    *,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
    callback: Callback | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    log: str | os.PathLike[str] | None = None,
    devices: Sequence[Any] | None = None,
    fields: AvatarFields | None = None,
    terms: ExtraTerms | None = None,
) -> Fitted:
    """Learn fields from frames. `callback(step, fields, terms)` is called now and then.

    `checkpoint`: a file that holds the run, from which `resume` goes on; `log`: a file of one
    JSON object a line; `devices`: those that share a step (default: all); `fields`: to begin with,
    in place of those of the config; `terms`: more terms of the loss.

    **Raises:** `ValueError` for frames that do not fit the body, a checkpoint of another run, or
    stored roots of a field that starts at random; `TrainingError` naming the term that is not
    finite; `Interrupted` after Ctrl-C.
    """
    started = time.perf_counter()
    check_start(config)
    check_minutes(config.minutes)
    deadline = None if config.minutes is None else started + 60 * config.minutes
    check_params(body, frames.params, what="frames.params")
    check_terms(terms or {})
    sharing = share_work(config, devices)
    begun = as_begun(config, checkpoint) if resume and checkpoint is not None else config
    keeper, notices = None, []
    frames = _of_one_shape(frames, betas, notices)
    learned, held = choose_frames(frames, begun, notices)
    chosen = frames[np.concatenate([learned, held])]
    if checkpoint is not None:
        identity = run_identity(body, chosen.params, betas, config, sharing)
        goes_on = _goes_on(checkpoint, resume, notices)
        saved = load_checkpoint(checkpoint, identity, notices) if goes_on else None
        keeper = Keeper(Path(checkpoint), identity, saved)
    elif resume:
        raise ValueError("resume=True needs checkpoint=FILE, the file to go on from")
    history = History(frames=len(learned))
    if keeper is not None and keeper.saved is not None:
        history = keeper.saved.history()
    history.notices += [said for said in notices if said not in history.notices]
    lines = None
    if log is not None and jax.process_index() == 0:
        lines = JsonLines(log, after=None if not history.steps_done else history.steps_done)

    if fields is None:
        initial = initial_fields(body, config, cache=cache, verbose=verbose)
    else:
        initial = fields
    clock = history.lap("prefit", started)
    start = initial
    if fields is None:
        start = settle_on_person(body, initial, betas, config, verbose=verbose)
    start = AvatarFields(start.skinning, start.geometry.within(frames[learned].params))
    history.lap("settle", clock)
    pool = None
    if keeper is not None and keeper.saved is not None:
        pool = keeper.saved.pool(centred(chosen.params))
    if pool is None:
        pool = _labelled_pool(body, chosen, betas, start, config, history, verbose=verbose)
    redraw = None
    if config.redraw_every:
        redraw = Redraw(body, frames[learned], betas, config, start.skinning)
    try:
        return train_pool(
            body,
            start,
            pool,
            betas,
            config,
            held=len(held),
            deadline=deadline,
            verbose=verbose,
            callback=callback,
            history=history,
            initial=initial,
            learned_from=learned,
            keeper=keeper,
            log=lines,
            devices=sharing,
            terms=terms,
            redraw=redraw,
        )
    finally:
        if redraw is not None:
            redraw.close()
        history.lap("total", started)


def _labelled_pool(
    body: BodyModel,
    frames: Frames,
    betas: Any,
    start: AvatarFields,
    config: FitConfig,
    history: History,
    *,
    verbose: bool,
) -> FramePool:
    """Points of the frames and, if they are stored, their roots."""
    check_expression(frames.params, history.notices)
    clock = time.perf_counter()
    with progress("points", len(frames), verbose=verbose, unit="frame") as bar:
        pool = label_frames(body, frames, config, bar=bar, notices=history.notices)
    clock = history.lap("labels", clock)
    if config.search.cached:
        with progress("roots", len(frames), verbose=verbose, unit="frame") as bar:
            pool = find_roots(body, betas, start.skinning, pool, config, bar=bar)
        history.found = float(pool.found.mean() / pool.points.shape[1])
        check_found(frames, np.asarray(pool.found), pool.points.shape[1], history.notices)
        history.lap("roots", clock)
    return pool


def choose_frames(
    frames: Frames, config: FitConfig, notices: list[str] | None = None
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " v"]]:
    """Indices of the frames to learn from, chosen for their variety, and of those to be judged by.

    The latter are of the end of each sequence, and none of the former is.

    **Warns:** `TrainingNotice` if `minutes` leave out frames that were asked for; what it says is
    added to `notices`.
    """
    rows, held = split_validation(frames, config.validation)
    count = min(frames_in_budget(config) or len(rows), len(rows))
    wanted = min(config.train_frames or len(rows), len(rows))
    say_fewer_frames(config, count, wanted, notices)
    return rows[varied_frames(frames.params[rows], count)], held


def train_pool(
    body: BodyModel,
    start: AvatarFields,
    pool: FramePool,
    betas: Any,
    config: FitConfig,
    *,
    held: int = 0,
    deadline: float | None = None,
    verbose: bool = True,
    callback: Callback | None = None,
    history: History | None = None,
    initial: AvatarFields | None = None,
    learned_from: Int[np.ndarray, " t"] | None = None,
    keeper: Keeper | None = None,
    log: JsonLines | None = None,
    devices: Devices = ONE_DEVICE,
    terms: ExtraTerms | None = None,
    redraw: Redraw | None = None,
) -> Fitted:
    """Train fields on points that are labelled already, for `config.steps` or as time allows.

    `deadline` is a time of `time.perf_counter`. The last `held` frames of the pool are for
    validation. `start` is what training begins from; `initial`, if it differs, what the result
    calls its step 0. `redraw` makes new points while steps go on.

    **Raises:** as `fit_fields`.
    """
    run = Run(
        body,
        start,
        pool,
        betas,
        config,
        held=held,
        deadline=deadline,
        callback=callback,
        history=History() if history is None else history,
        initial=start if initial is None else initial,
        learned_from=(
            np.arange(pool.points.shape[0] - held) if learned_from is None else learned_from
        ),
        keeper=keeper,
        log=log,
        devices=devices,
        terms=terms,
        redraw=redraw,
    )
    return run.to_the_end(verbose=verbose)


def subject_betas(frames: Frames) -> np.ndarray:
    """The one shape of the person: the mean of the frames' betas."""
    return np.asarray(frames.params.betas).mean(0)


def _of_one_shape(frames: Frames, betas: Any, notices: list[str]) -> Frames:
    """The frames with the person's shape in place of their own: there is one canonical body.

    **Warns:** `TrainingNotice` if the shapes differ; what it says is added to `notices`.
    """
    apart = float(np.ptp(np.asarray(frames.params.betas), axis=0).max(initial=0.0))
    if apart > _SAME_BETAS:
        notify(
            f"betas differ from frame to frame, by up to {apart:.2f}: one person has one shape, "
            "and their mean is taken for all.",
            notices,
            stacklevel=4,
        )
    return frames.with_params(with_betas(frames.params, betas), frames.body)


def _goes_on(checkpoint: str | os.PathLike[str], resume: bool, notices: list[str]) -> bool:
    """Whether there is something to go on from."""
    if not resume or Path(checkpoint).exists():
        return resume
    notify(
        f"no checkpoint at {os.fspath(checkpoint)}: the run begins at step 0.",
        notices,
        stacklevel=4,
    )
    return False
