"""From frames to an avatar in one call."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from ..body import BodyModel
from ..frames import Frames
from ..training import (
    AvatarFields,
    FitConfig,
    History,
    fit_fields,
    quick,
    subject_betas,
)
from .avatar import Avatar


@dataclass(frozen=True)
class Fit:
    """An avatar, the one it started from, and the way between. Unpacks to avatar and history."""

    avatar: Avatar
    history: History
    before: Avatar

    def __iter__(self) -> Iterator[Any]:
        return iter((self.avatar, self.history))


def fit(
    frames: Frames,
    config: FitConfig | None = None,
    *,
    body: BodyModel | None = None,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
    callback: Callable[[int, AvatarFields, dict[str, float]], None] | None = None,
) -> Fit:
    """Learn an avatar of the person in `frames`.

    `avatar, history = fit(frames)` learns with the quick preset; `config` may be any other
    (`paper()`, or either with entries replaced). `body` is the model that the parameters are for;
    frames from our loaders know it. The person's one shape is the mean of the
    frames' betas. `cache` overrides the cache folder of the fields fitted to the body's mean
    shape; `verbose=False` is quiet.

    **Raises:** `ValueError` naming the frame for parameters or meshes that cannot be used;
    `TrainingError` if a loss is not finite.
    """
    config = quick() if config is None else config
    body = frames.body if body is None else body
    if body is None:
        raise ValueError(
            "these frames do not say which body they are for: pass body=load_body(...)"
        )
    betas = subject_betas(frames)
    fitted = fit_fields(
        body, frames, betas, config, cache=cache, verbose=verbose, callback=callback
    )
    avatar = Avatar(body, betas, fitted.fields, config, fitted.history.steps_done)
    return Fit(avatar, fitted.history, Avatar(body, betas, fitted.initial, config, 0))
