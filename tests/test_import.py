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


def test_import_time(tmp_path, monkeypatch):
    """Of all public names: `import xavatar_jax` alone imports next to nothing.

    From bytecode, whatever the environment says about writing it: the first turn compiles.
    """
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
    monkeypatch.setenv("PYTHONPYCACHEPREFIX", str(tmp_path))
    clock = (
        "import time; t = time.perf_counter(); import {0}; [getattr({0}, n) for n in dir({0})]; "
        "print(time.perf_counter() - t)"
    )
    best = {"optimistix": float("inf"), "xavatar_jax": float("inf")}
    for _ in range(3):  # in turn, so that a busy moment meets both
        for name in best:
            best[name] = min(best[name], float(run(clock.format(name))))
    assert best["xavatar_jax"] <= ALLOWED_RATIO * best["optimistix"], best
