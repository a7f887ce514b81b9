"""Fixtures of every test: seeds, float64, a small random body and the bundled one."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import COLUMNS, PARENTS, toy_arrays
from toy_smplx import write_toy_body

from xavatar_jax.body import load_body
from xavatar_jax.synthetic import synthetic_body

# What takes longest begins.
_FIRST = ("avatar", "xavatar", "methods", "viewer")
_SHORT_RUNS = (
    *("body", "correspondence", "fields", "kinematics", "learning", "methods", "motion"),
    *("report", "sampling", "xavatar"),
)
_MAPS = 20_000  # of the 65,530 that Linux grants; a thousand programs need about as many


def pytest_configure(config):
    """What is compiled is shared by workers and by programs that tests start, and compiled fast."""
    if hasattr(config, "workerinput") or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = tempfile.mkdtemp(prefix="xavatar_jax_compiled.")
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    if jax.__version_info__[:2] == (0, 10):  # others may not know the flag, and stop at it
        # Without the newer emitter, a program compiles in two thirds of the time.
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=false"


@pytest.hookimpl(tryfirst=True)  # the workers read the marks in this hook too
def pytest_collection_modifyitems(items):
    """With several workers, a file stays on one: what it has made is made once.

    So does the folder of the avatar, which takes most of a minute to learn.
    """

    def place(item):
        folder = item.path.parent.name
        return _FIRST.index(folder) if folder in _FIRST else len(_FIRST)

    items.sort(key=place)
    for item in items:
        folder = item.path.parent
        group = folder if folder.name == "avatar" else item.path
        item.add_marker(pytest.mark.xdist_group(str(group)))


@pytest.fixture(scope="module", autouse=True)
def free_programs():
    """Compiled programs are dropped when they fill a good part of the memory maps of a process."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > _MAPS:
        jax.clear_caches()


@pytest.fixture(scope="module", autouse=True)
def quick_compilation(request):
    """Programs that run for milliseconds are compiled without much optimisation."""
    short = request.path.parent.name in _SHORT_RUNS
    jax.config.update("jax_disable_most_optimizations", short)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


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
def toy_body(tmp_path_factory):
    """A small body of capsules on SMPL-X's tree, read through the ordinary loader."""
    path = write_toy_body(tmp_path_factory.mktemp("toy") / "SMPLX_NEUTRAL.npz")
    return load_body(path, num_betas=10, num_expression=10)


@pytest.fixture(scope="session")
def bundled_body():
    """The bundled human: built on first use, then read from the user's cache folder."""
    return synthetic_body()
