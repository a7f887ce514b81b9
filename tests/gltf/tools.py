"""Programs that read GLB files, where they are installed; else the test is skipped."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

_HERE = Path(__file__).parent


def validation_report(path: Path) -> dict[str, Any]:
    """The report of the Khronos validator."""
    return json.loads(_node("validate.mjs", "gltf-validator", path))


def three_vertices(path: Path, fps: float, frames: list[int]) -> tuple[np.ndarray, dict[str, Any]]:
    """Vertices (n, V, 3) as three.js poses them, and what it found in the file."""
    out = path.with_suffix(".f32")
    counts = json.loads(_node("three_pose.mjs", "three", path, out, fps, *frames))
    return np.fromfile(out, np.float32).reshape(len(frames), -1, 3), counts


def blender_vertices(
    path: Path, fps: float, frames: list[int]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Vertices (n, V, 3) as Blender poses them, in glTF's axes, and what it found."""
    python = os.environ.get("BPY_PYTHON")
    if python is None:
        if importlib.util.find_spec("bpy") is None:
            pytest.skip("no Blender: pip install bpy, in this environment or in another whose "
                        "interpreter BPY_PYTHON names")  # fmt: skip
        python = sys.executable
    out = path.with_suffix(".npz")
    _run([python, _HERE / "blender_pose.py", path, out, fps, *frames])
    with np.load(out) as found:
        arrays = dict(found)
    return arrays.pop("vertices"), arrays


def _node(script: str, package: str, *arguments: Any) -> str:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no Node.js: install it, and npm")
    folder = Path(os.environ.get("GLTF_TOOLS", _HERE.parent))
    if not (folder / "node_modules" / package).is_dir():
        pytest.skip(f"no {package}: npm install {package} in a folder that GLTF_TOOLS names")
    return _run([node, _HERE / script, *arguments], folder)


def _run(command: list[Any], folder: Path | None = None) -> str:
    done = subprocess.run(
        list(map(str, command)), cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
