"""SNARF: forward skinning with searched roots, on a body-only skeleton (Chen et al., ICCV 2021)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ..avatar import BodyOnlyAvatar, body_only, body_only_frames
from ..body import BodyModel
from ..fields import MLPShape
from ..frames import Frames, known_body
from ..sampling import SamplingPlan
from .result import Fit
from .xavatar import FitConfig, fit, paper, quick


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
    frames a step; cross-entropy, bone and joint terms, and no term on the template's weights.
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
                width=256, depth=8, octaves=0, skip=(4,), condition_at=(4,), condition_embedding=8
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
    **options: Any,
) -> Fit:
    """Learn an avatar with SNARF: `xavatar_jax.fit` on a body-only skeleton.

    `config` is `snarf_quick()` unless given. Fingers, jaw, eyes and expression of the parameters
    are not used. `options` are those of `xavatar_jax.fit`.

    **Raises:** `ValueError` for a body without limbs; otherwise as `xavatar_jax.fit`.
    """
    config = snarf_quick() if config is None else config
    whole = known_body(frames, body)
    cut = body_only(whole)
    done = fit(body_only_frames(cut, frames), config, body=cut, **options)

    def on_whole(avatar: Any) -> BodyOnlyAvatar:
        return BodyOnlyAvatar(whole, replace(avatar, method="snarf"))

    return replace(done, avatar=on_whole(done.avatar), before=on_whole(done.before))
