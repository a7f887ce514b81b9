"""Labelled points of three frames of the toy body, with roots."""

from __future__ import annotations

import pytest
from small_runs import Case, fresh_model, labelled, posed_frames, tiny, with_roots

import xavatar_jax as xa


@pytest.fixture(scope="session")
def case(toy_body):
    frames, config = posed_frames(toy_body, 3), tiny(xa.quick())
    model = fresh_model(toy_body, config)
    data = labelled(toy_body, frames, config)
    table, data = with_roots(toy_body, model, data, config)
    return Case(toy_body, frames, config, model, table, data)
