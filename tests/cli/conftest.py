"""An avatar that costs nothing: untrained small networks, whose surface is a coarse ball."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from xavatar_jax.avatar import Avatar
from xavatar_jax.cli import main
from xavatar_jax.fields import GeometrySpec, MLPShape, ModelSpec, SkinningSpec, build_model


@pytest.fixture(scope="session")
def avatar_file(bundled_body, tmp_path_factory) -> Path:
    tiny = MLPShape(width=16, depth=3, octaves=0, skip=(), condition_at=(0,))
    spec = ModelSpec(
        skinning=SkinningSpec(kind="mlp", mlp=replace(tiny, condition_at=())),
        geometry=GeometrySpec(kind="mlp", mlp=tiny),
    )
    path = tmp_path_factory.mktemp("avatar") / "avatar.npz"
    model = build_model(spec, bundled_body, key=jax.random.key(0))
    Avatar(bundled_body, np.zeros(10), model, spec, options={"preset": "paper"}).save(path)
    return path


@pytest.fixture
def coarse(monkeypatch):
    """Surfaces of large cells, for all avatars."""
    extract = Avatar._extract_canonical
    monkeypatch.setattr(
        Avatar, "_extract_canonical", lambda self, cell, limit: extract(self, 0.08, limit)
    )


@pytest.fixture(scope="session")
def motion_file(tmp_path_factory) -> Path:
    """Seven frames in the AMASS layout, written without the library: the left elbow bends."""
    poses = np.zeros((7, 165))
    poses[:, 0] = np.pi / 2  # y up to z up
    poses[:, 3 * 18 + 1] = np.linspace(0, -1.2, 7)
    path = tmp_path_factory.mktemp("motion") / "bend.npz"
    np.savez(
        path, poses=poses, trans=np.zeros((7, 3)), betas=np.zeros(10),
        expression=np.linspace(0, 2, 70).reshape(7, 10), gender=np.array("neutral"),
        surface_model_type=np.array("smplx"), mocap_frame_rate=np.array(30.0),
    )  # fmt: skip
    return path


@pytest.fixture
def call(capsys):
    """Run a command line in this process: exit code, stdout, stderr."""

    def run(*words: object) -> tuple[int, str, str]:
        code = main([str(word) for word in words])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run
