"""Runs that take seconds, for the tests of training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import xavatar_jax as xa
from xavatar_jax.fields import GridSpacing
from xavatar_jax.frames import frames_from_params


def tiny(config: xa.FitConfig) -> xa.FitConfig:
    coarse = GridSpacing(body=0.04, hands=0.01, face=0.013, band=0.06)
    points = replace(config.points, body=200, face=60, eyes_mouth=40, hand=100, box=20)
    return replace(
        config,
        steps=12,
        frames_per_step=2,
        points_per_step=64,
        train_frames=3,
        points=points,
        skinning=replace(config.skinning, grid=coarse, mlp=replace(config.skinning.mlp, width=32)),
        search=replace(config.search, grid=coarse),
    )


def posed_frames(body: xa.BodyModel, count: int, *, constant: bool = False) -> xa.Frames:
    """Frames of the body itself in random poses, or in one and the same."""
    rng = np.random.default_rng(3)
    pose = np.deg2rad(10) * rng.standard_normal((count, body.num_joints, 3))
    pose = np.repeat(pose[:1], count, axis=0) if constant else pose
    return frames_from_params(body, xa.BodyParams.create(body, pose=pose))
