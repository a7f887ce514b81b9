"""A labelled pool of three frames, and fits that skip the mean shape."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from small_runs import posed_frames, tiny
from xavatar_jax.training import fresh_fields, loop, step
from xavatar_jax.training.pool import find_roots, label_frames
from xavatar_jax.training.progress import progress

import xavatar_jax as xa


@pytest.fixture(scope="session")
def case():
    body = xa.synthetic_body()
    frames = posed_frames(body, 3)
    config = tiny(xa.quick())
    fields = fresh_fields(body, config)
    with progress("", 3, verbose=False) as bar:
        pool = label_frames(body, frames, config, bar=bar)
        pool = find_roots(body, np.zeros(10), fields.skinning, pool, config, bar=bar)
    return body, frames, config, fields, pool


@pytest.fixture(scope="module")
def no_prefit(case):
    """Fits begin from fresh fields, already settled: what they begin from is not tested here."""
    fields = case[3]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "initial_fields", lambda *_, **__: fields)
        patch.setattr(loop, "settle_on_person", lambda *_, **__: fields)
        yield


@pytest.fixture
def other_objective(monkeypatch):
    """Replaces the objective of geometry, in programs compiled before as well."""

    def replace(objective):
        monkeypatch.setattr(step, "geometry_objective", objective)
        jax.clear_caches()

    yield replace
    jax.clear_caches()
