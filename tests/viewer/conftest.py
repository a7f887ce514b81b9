"""One avatar that has learned nothing but the mean shape, with a coarse surface."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.avatar import CellSizes
from xavatar_jax.fields import GridSpacing, build_model
from xavatar_jax.methods.xavatar import start


@pytest.fixture(scope="session")
def avatar(bundled_body, tmp_path_factory) -> xa.Avatar:
    config = xa.quick()
    coarse = GridSpacing(body=0.03, hands=0.0075, face=0.01, band=0.06)
    spec = replace(config, skinning=replace(config.skinning, grid=coarse)).spec
    model = build_model(spec, bundled_body, key=jax.random.key(0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "_POINTS", 60_000)  # a rough person is enough
        model = start.fit_mean_shape(
            model, spec, bundled_body, steps=60, optimiser=config.optimiser, seed=0,
            cache=tmp_path_factory.mktemp("mean_shape"), verbose=False,
        )  # fmt: skip
    made = xa.Avatar(bundled_body, np.zeros(10, np.float32), model, spec)
    # What is shown of the surface is the same whatever its cells, and these take a second.
    made.__dict__["_base_mesh"] = made.canonical_mesh(cell=CellSizes().scaled(2.5))
    return made


@pytest.fixture(scope="session")
def motion(bundled_body) -> xa.Motion:
    """Both arms come down from the rest pose while the body turns and walks."""
    count, names = 7, bundled_body.tree.names
    pose = np.zeros((count, 55, 3))
    part = np.linspace(0, 1, count)
    pose[:, names.index("left_shoulder"), 2] = -1.1 * part
    pose[:, names.index("right_shoulder"), 2] = 1.1 * part
    pose[:, names.index("jaw"), 0] = 0.3 * part
    pose[:, 0, 1] = 0.4 * part
    expression = np.zeros((count, 10))
    expression[:, 0] = 2.0 * part
    transl = np.outer(part, [0.3, 0.0, 0.2])
    params = xa.BodyParams.create(
        bundled_body, pose=pose, betas=np.zeros(10), expression=expression, transl=transl
    )
    return xa.Motion.from_params(params, fps=10.0, source="arms.npz")
