"""Labelled points of three frames of the toy body, with roots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from small_runs import fresh_model, labelled, posed_frames, tiny, with_roots

import xavatar_jax as xa


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


@pytest.fixture(scope="session")
def case(toy_body):
    frames, config = posed_frames(toy_body, 3), tiny(xa.quick())
    model = fresh_model(toy_body, config)
    data = labelled(toy_body, frames, config)
    table, data = with_roots(toy_body, model.skinning, data, config)
    return Case(toy_body, frames, config, model, table, data)
