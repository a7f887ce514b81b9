"""From frames to an avatar in one call."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..body import BodyModel
from ..frames import Frames, known_body
from ..training import (
    AvatarFields,
    Callback,
    ExtraTerms,
    FitConfig,
    Fitted,
    History,
    Interrupted,
    TrainingError,
    fit_fields,
    quick,
    subject_betas,
)
from .avatar import Avatar


@dataclass(frozen=True)
class Fit:
    """An avatar, the one it started from, and the way between. Unpacks to avatar and history.

    `frames`: those of the training frames that it was learned from.
    """

    avatar: Avatar
    history: History
    before: Avatar
    frames: Frames

    def __iter__(self) -> Iterator[Any]:
        return iter((self.avatar, self.history))


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
    fields: AvatarFields | None = None,
    terms: ExtraTerms | None = None,
) -> Fit:
    """Learn an avatar of the person in `frames`.

    `avatar, history = fit(frames)` learns with the quick preset; `config` may be any other
    (`paper()`, or either with entries replaced). `body` is the model that the parameters are for;
    frames from our loaders know it. The person's one shape is the mean of the
    frames' betas. `cache` overrides the cache folder of the fields fitted to the body's mean
    shape; `verbose=False` is quiet.

    The end of each sequence is not learned from: the fields that do best there are kept
    (`config.validation`). Training may be watched and taken up again:

    - `callback(step, fields, terms)` is called every 25 steps (`config.report_every`); `log` is a
      file that gets one JSON object a line as often.
    - `checkpoint` is a file that holds the whole run, written now and then, at the end, and when
      training is stopped; `resume=True` goes on from it, with the numbers of an uninterrupted
      run on the same machine.
    - `devices` share each step: all that JAX sees, unless given.

    What is learned may be of one's own making, and is then to be given again to `resume`:

    - `fields`: to begin with, in place of those that the config describes and the mean shape
      gives; of any class, in the canonical space of the person.
    - `terms`: more terms of the loss, `{name: (weight, term)}` with
      `term(fields, batch, key) -> number`.

    **Raises:** `ValueError` naming the frame for parameters or meshes that cannot be used, or
    what differs for a checkpoint of another run; `TrainingError` if a loss is not finite, and
    `Interrupted` after Ctrl-C, both with what was learned until then as `error.fitted`, a `Fit`.
    **Warns:** `TrainingNotice` naming frames whose mesh and parameters do not fit.
    """
    config = quick() if config is None else config
    body = known_body(frames, body)
    betas = subject_betas(frames)

    def finished(fitted: Fitted) -> Fit:
        avatar = Avatar(body, betas, fitted.fields, config, fitted.history.best_step)
        before = Avatar(body, betas, fitted.initial, config, 0)
        return Fit(avatar, fitted.history, before, frames[fitted.learned_from])

    try:
        fitted = fit_fields(
            body,
            frames,
            betas,
            config,
            cache=cache,
            verbose=verbose,
            callback=callback,
            checkpoint=checkpoint,
            resume=resume,
            log=log,
            devices=devices,
            fields=fields,
            terms=terms,
        )
    except (TrainingError, Interrupted) as error:
        error.fitted = finished(error.fitted)
        raise
    return finished(fitted)
