"""Runs on the body of capsules that take seconds, for the tests of X-Avatar."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

import xavatar_jax as xa
from xavatar_jax.correspondence import start_table
from xavatar_jax.fields import GridSpacing, MLPShape, build_model, grids_for_search
from xavatar_jax.frames import frames_from_params
from xavatar_jax.methods.xavatar.roots import FrameData, frame_data, search_roots, tabulated
from xavatar_jax.sampling import VolumePoints, volume_points

COARSE = GridSpacing(body=0.05, hands=0.02, face=0.03, band=0.06)


def tiny(config: xa.FitConfig) -> xa.FitConfig:
    """The same run on coarse grids and narrow networks, with few points and steps."""
    return replace(
        config,
        steps=12,
        frames_per_step=2,
        points_per_step=64,
        skinning_points=32,
        train_frames=3,
        prefit_steps=0,
        weights_steps=0,
        points=replace(config.points, body=120, face=30, eyes_mouth=0, hand=40, box=20),
        skinning=replace(
            config.skinning, grid=COARSE, correction=COARSE,
            mlp=MLPShape(width=16, depth=2, octaves=0, skip=(), condition_at=()),
        ),
        geometry=replace(
            config.geometry, spacing=(0.12, 0.06, 0.03), log2_size=12, width=16,
            mlp=MLPShape(width=48, depth=2, skip=()),
        ),
        search=replace(config.search, grid=COARSE, max_steps=min(config.search.max_steps, 12)),
    )  # fmt: skip


def posed_frames(body: xa.BodyModel, count: int, *, constant: bool = False) -> xa.Frames:
    """Frames of the body itself in random poses, or in one and the same."""
    rng = np.random.default_rng(3)
    pose = np.deg2rad(10) * rng.standard_normal((count, body.num_joints, 3))
    pose = np.repeat(pose[:1], count, axis=0) if constant else pose
    return frames_from_params(body, xa.BodyParams.create(body, pose=pose))


def labelled(body: xa.BodyModel, frames: xa.Frames, config: xa.FitConfig) -> FrameData:
    """Labelled points of the frames, without roots."""
    drawn = [
        volume_points(frames[k], body.parts, config.points, np.random.default_rng(k))
        for k in range(len(frames))
    ]
    samples = jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)
    return frame_data(body, VolumePoints(*samples), frames.params)


def with_roots(
    body: xa.BodyModel, model: Any, data: FrameData, config: xa.FitConfig
) -> tuple[Any, FrameData]:
    """The tabulated field, and the data with roots on it."""
    search, skinning = config.search, model.skinning
    betas = np.zeros(body.num_betas)
    table = tabulated(skinning, grids_for_search(skinning, body, betas, search.grid))
    starts = start_table(body, search.starts)
    return table, search_roots(
        model.geometry, table, data, starts,
        keep=search.keep, atol=search.atol, max_steps=search.max_steps,
    )  # fmt: skip


def fresh_model(body: xa.BodyModel, config: xa.FitConfig) -> Any:
    """The model that `fit` builds, fitted to nothing."""
    return build_model(config.spec, body, key=jax.random.key(config.seed))


def interrupt_at(step: int) -> Any:
    """A callback that sends the signal of Ctrl-C."""

    def callback(k: int, model: Any, terms: Any) -> None:
        if k == step:
            os.kill(os.getpid(), signal.SIGINT)

    return callback


def same(a: Any, b: Any) -> bool:
    """Whether all leaves are equal, bit for bit."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)


@dataclass(frozen=True)
class Case:
    """A body, three frames of it, a config, the model at step 0, its table, and the data."""

    body: xa.BodyModel
    frames: xa.Frames
    config: xa.FitConfig
    model: Any
    table: Any
    data: Any

    def fit(self, frames=None, config=None, **options):
        """`fit` without the fit to the mean shape: what it starts from is tested elsewhere."""
        frames = self.frames if frames is None else frames
        config = self.config if config is None else config
        options = {"model": self.model, "body": self.body, "verbose": False, **options}
        return xa.fit(frames, config, **options)
