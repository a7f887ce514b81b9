"""Importing the library is light: nothing heavy loads, nothing runs on a device."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import xavatar_jax

HEAVY = ("trimesh", "scipy.spatial", "scipy.ndimage", "igl", "embreex", "PIL", "viser",
         "torch", "pygltflib", "matplotlib")  # fmt: skip
# In the same run, on the same machine: what the library adds to its own solver library.
ALLOWED_RATIO = 1.5


def run(code: str) -> str:
    environment = dict(os.environ)
    source = str(Path(xavatar_jax.__file__).parents[1])
    environment["PYTHONPATH"] = os.pathsep.join([source, environment.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_nothing_heavy_is_loaded_and_nothing_computed():
    code = f"""
import json, sys
import optimistix
before = {{name for name in {HEAVY!r} if name in sys.modules}}
import xavatar_jax
for name in dir(xavatar_jax):  # each is imported when asked for
    getattr(xavatar_jax, name)
from jax._src import xla_bridge
loaded = [name for name in {HEAVY!r} if name in sys.modules and name not in before]
print(json.dumps([loaded, sorted(xla_bridge._backends)]))
"""
    loaded, backends = json.loads(run(code))
    assert loaded == []
    assert backends == []


def test_import_is_quiet():
    assert run("import xavatar_jax") == ""


def test_import_time():
    clock = "import time; t = time.perf_counter(); {}; print(time.perf_counter() - t)"
    every = "import xavatar_jax as xa; [getattr(xa, name) for name in dir(xa)]"
    best = {"import optimistix": float("inf"), every: float("inf")}
    for _ in range(3):  # in turn, so that a busy moment meets both
        for what in best:
            best[what] = min(best[what], float(run(clock.format(what))))
    assert best[every] <= ALLOWED_RATIO * best["import optimistix"], best
