"""One small avatar of the bundled body, learned once for all tests of this folder."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.fields import GridSpacing
from xavatar_jax.frames import frames_from_params
from xavatar_jax.methods.xavatar import start


@dataclass(frozen=True)
class SmallRun:
    """A run that takes seconds: few frames, coarse grids, and frames it has not seen."""

    body: xa.BodyModel
    train: xa.Frames
    test: xa.Frames
    config: xa.FitConfig
    fit: xa.Fit


def small_config() -> xa.FitConfig:
    config = xa.quick()
    coarse = GridSpacing(body=0.03, hands=0.0075, face=0.01, band=0.06)
    return replace(
        config,
        steps=120,
        train_frames=8,
        frames_per_step=8,
        points_per_step=256,
        prefit_steps=60,
        polish_every=50,
        points=replace(config.points, body=1000, face=300, eyes_mouth=200, hand=400, box=100),
        skinning=replace(config.skinning, grid=coarse),
    )


def random_frames(body: xa.BodyModel, count: int, seed: int) -> xa.Frames:
    rng = np.random.default_rng(seed)
    pose = np.deg2rad(12) * rng.standard_normal((count, body.num_joints, 3))
    pose[:, [0, 3, 6, 9]] *= 0.3
    pose[:, 22] = [0.15, 0, 0]  # a jaw that closes further than at rest would cross the lips
    betas = 0.4 * np.random.default_rng(7).standard_normal(10)
    params = xa.BodyParams.create(
        body, pose=pose, betas=betas, transl=rng.standard_normal((count, 3))
    )
    return frames_from_params(body, params)


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> SmallRun:
    body = xa.synthetic_body()
    train, test = random_frames(body, 8, 0), random_frames(body, 3, 1)
    config = small_config()
    cache = tmp_path_factory.mktemp("mean_shape")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "_POINTS", 60_000)  # a rough start is enough
        fit = xa.fit(train, config, body=body, cache=cache, verbose=False)
    return SmallRun(body, train, test, config, fit)
