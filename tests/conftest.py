"""Fixtures of every test: seeds, float64, a small random body and the bundled one."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from helpers import COLUMNS, PARENTS, toy_arrays

from xavatar_jax.body import load_body, synthetic_body


@pytest.fixture(scope="session", autouse=True)
def compile_once(tmp_path_factory):
    """What was compiled once in a run is not compiled again: many tests share programs."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path_factory.mktemp("compiled")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture
def rng():
    """A generator that starts alike in every test."""
    return np.random.default_rng(20)


@pytest.fixture
def x64():
    """Double precision for the length of one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def family_arrays():
    """Arrays of a small random model of each kind."""
    return {kind: toy_arrays(PARENTS[kind], columns=COLUMNS[kind]) for kind in PARENTS}


@pytest.fixture(scope="session")
def family_paths(family_arrays, tmp_path_factory):
    """The same, as `.npz` files."""
    folder = tmp_path_factory.mktemp("family")
    paths = {}
    for kind, arrays in family_arrays.items():
        paths[kind] = folder / f"{kind}_model.npz"
        np.savez(paths[kind], **arrays)
    return paths


@pytest.fixture(scope="session")
def family(family_paths):
    """A loaded small body of each kind, float32."""
    return {kind: load_body(path) for kind, path in family_paths.items()}


@pytest.fixture(scope="session")
def bundled_body():
    """The bundled human: built on first use, then read from the user's cache folder."""
    return synthetic_body()
