"""SNARF: forward skinning with searched roots, on a body-only skeleton (Chen et al., ICCV 2021)."""

from __future__ import annotations

import os
from dataclasses import replace

from ..avatar import fit
from ..body import BodyModel
from ..fields import MLPShape
from ..frames import Frames, known_body
from ..sampling import SamplingPlan
from ..training import FitConfig, paper, quick
from .baseline import Baseline
from .skeleton import body_only, body_only_frames


def snarf_quick() -> FitConfig:
    """SNARF's starts and even sampling with the fields and schedule of the preset `quick`."""
    config = quick()
    return replace(
        config,
        preset="snarf",
        points=replace(config.points, uniform=True),
        search=replace(config.search, starts="body"),
    )


def snarf_paper() -> FitConfig:
    """SNARF's networks, sampling, losses and schedule (its public code, minimally clothed).

    Geometry 8 x 256, skinning 4 x 128; 2000 points near the surface and 250 in the box, of 8
    frames a step; cross-entropy, bone and joint terms, and no hold on the template's weights.
    """
    config = paper()
    return replace(
        config,
        preset="snarf-paper",
        frames_per_step=8,
        points_per_step=2250,
        points=SamplingPlan(
            body=2000, face=0, eyes_mouth=0, hand=0, box=250, by_vertex=False, uniform=True
        ),
        skinning=replace(
            config.skinning,
            mlp=MLPShape(width=128, depth=4, octaves=0, skip=(), condition_at=()),
        ),
        geometry=replace(
            config.geometry,
            mlp=MLPShape(
                width=256,
                depth=8,
                octaves=0,
                skip=(4,),
                condition_at=(4,),
                condition_embedding=8,
            ),
        ),
        search=replace(config.search, starts="body", keep=9),
        losses=replace(config.losses, surface=0.0),
    )


def fit_snarf(
    frames: Frames,
    config: FitConfig | None = None,
    *,
    body: BodyModel | None = None,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
) -> Baseline:
    """Learn SNARF's avatar of the person in `frames`: `xavatar_jax.fit` on a body-only skeleton.

    `config` is `snarf_quick()` unless given; fingers, jaw, eyes and expression of the frames'
    parameters are not used. The other arguments are those of `fit`.

    **Raises:** `ValueError` for a body without a body; else as `fit`.
    """
    config = snarf_quick() if config is None else config
    whole = known_body(frames, body)
    cut = body_only(whole)
    done = fit(body_only_frames(cut, frames), config, body=cut, cache=cache, verbose=verbose)
    return Baseline(whole, done.avatar, done.history, done.frames)
