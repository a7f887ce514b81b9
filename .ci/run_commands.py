"""Runs the commands of README, CONTRIBUTING and docs as they stand there, in a copy of the project.

    python .ci/run_commands.py RESULTS

RESULTS is a folder with what other stages have left: `fit_grab/`, `part_aware.json` and
`animate.json`. A command that `HOW` does not name is run as it stands.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("README.md", "benchmarks", "docs", "examples", "notebooks", "pyproject.toml", "src")
SHORT = "--minutes 0.5 --steps 3 --train-frames 6 --eval-frames 1 --prefit-steps 60 --quiet"


class How(NamedTuple):
    """`run` it, with more options if there are any; or say `why_not`."""

    run: bool
    more: str = ""
    why_not: str = ""


def skip(why: str) -> How:
    return How(False, why_not=why)


_INSTALL = skip("the environment stage installs")
_FIT = ".venv/bin/python examples/fit_grab.py"
_OWN = f"{_FIT} --body MODELS/smplx/SMPLX_NEUTRAL.npz --data MY_FOLDER"
_GRAB = f"{_FIT} --model-dir MODELS --data"
_XAVATAR = ".venv/bin/xavatar"
_AVATAR = "out/fit_grab/avatar.npz"
_VENV = "python3 -m venv .venv && .venv/bin/pip install -q -e"
_FIGURES = ".venv/bin/python docs/figures/update.py"
HOW = {
    f"{_VENV} .": _INSTALL,
    f"{_VENV} . && {_FIT}": skip("the example's stage"),
    f'{_VENV} ".[test]" && .venv/bin/python -m pytest': skip("the last stage"),
    f'{_VENV} ".[dev]"': _INSTALL,
    f'{_VENV} ".[docs]" jupyterlab': _INSTALL,
    ".venv/bin/jupyter lab notebooks": skip("the notebooks' stage"),
    _FIT: skip("the example's stage"),
    f"{_FIT} --steps 300 --train-frames 24 --eval-frames 3 --out out/short": skip(
        "the example's stage, with about these options"
    ),
    f"{_FIT} --out out/s1 --resume": skip("tests/methods/xavatar/test_resuming.py"),
    f"{_OWN} --out out/mine": skip("the same with --test is run"),
    f"{_OWN} --test wave --out out/mine": How(True, SHORT),
    f"{_GRAB} GRAB/s1 --out out/s1": skip("the same with another folder is run"),
    f"{_GRAB} AMASS/GRAB/s1 --out out/s1": skip("tests/datasets, and the same with meshes is run"),
    f"{_XAVATAR} fit --minutes 2 --eval-frames 4": skip("the example's stage: one code"),
    f"{_XAVATAR} fit --steps 60 --train-frames 12 --eval-frames 2 --config.losses.surface 50 "
    "--out out/short": skip("the example's stage, and tests/cli"),
    f"{_XAVATAR} animate {_AVATAR} bundled --out out/animation.webp": skip(
        "the same with another motion is run"
    ),
    # An avatar's surface takes some time to extract: once for each kind of command is enough.
    f"{_XAVATAR} animate {_AVATAR} bundled --out out/pictures --fps 5 --end 1": skip("tests/cli"),
    f"{_XAVATAR} export {_AVATAR} --out out/avatar.ply": skip("tests/cli"),
    f"{_XAVATAR} export {_AVATAR} bundled --frame 40 --out out/frame_40.obj": skip("tests/cli"),
    f"{_XAVATAR} export {_AVATAR} bundled --end 0.5 --out out/meshes": skip("tests/cli"),
    f"{_XAVATAR} export {_AVATAR} --out out/weights.npz": skip("tests/cli"),
    f"{_XAVATAR} view {_AVATAR} bundled --open": skip("runs until Ctrl-C; tests/viewer"),
    "ssh -L 8080:localhost:8080 HOST": skip("takes another machine"),
    f"{_XAVATAR} export {_AVATAR} bundled --out out/avatar.glb": skip(
        "the same with two motions is run"
    ),
    ".venv/bin/ruff check && .venv/bin/ruff format --check": skip("stages lint and format"),
    ".venv/bin/pyright": skip("stage types"),
    ".venv/bin/mkdocs build": skip("stage site"),
    ".venv/bin/python -m pytest": skip("the last stage"),
    f"{_FIGURES} --metrics out/fit_grab/metrics.json": How(True),
    f"{_FIGURES} --part-aware part_aware.json": How(True),
    f"{_FIGURES} --animate animate.json": How(True),
    ".venv/bin/python docs/pictures/make.py": How(True),
    ".venv/bin/python docs/pictures/conventions.py": How(True),
    ".venv/bin/python benchmarks/animate.py out/fit_grab/avatar.npz --json animate.json": skip(
        "a stage of its own"
    ),
    ".venv/bin/python benchmarks/part_aware_vs_all_bones.py --quick --json part_aware.json": skip(
        "a stage of its own"
    ),
    ".venv/bin/python benchmarks/correspondence.py --json search.json --picture search.png": skip(
        "a stage of its own"
    ),
    ".venv/bin/python benchmarks/gradients.py --json gradients.json": How(
        True, "--quick --prefit-steps 20"
    ),
    ".venv/bin/python benchmarks/part_borders.py --json borders.json": How(True, "--quick"),
    ".venv/bin/python benchmarks/table1_ablations.py --json table1.json": How(
        True, "--quick --only complete"
    ),
    ".venv/bin/python benchmarks/table2_grab.py --json table2.json": How(
        True, "--quick --only quick"
    ),
    ".venv/bin/python benchmarks/memory.py --json memory.json": How(True, "--quick --counts 60"),
    # Its one point is the run of the table before.
    ".venv/bin/python benchmarks/accuracy_over_time.py --json curve.json --picture curve.png": How(
        True, "--quick --table2 table2.json"
    ),
    "npm install --prefix ~/gltf_tools gltf-validator three": skip("a stage of its own"),
    "python3.11 -m venv ~/bpy && ~/bpy/bin/pip install bpy==5.0.1": skip("a stage of its own"),
    "GLTF_TOOLS=~/gltf_tools BPY_PYTHON=~/bpy/bin/python .venv/bin/python -m pytest tests/export "
    "tests/avatar": skip("the last stage"),
}


def commands() -> dict[str, str]:
    """Every command line of the texts, and the text that it is in."""
    found = {}
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))):
        text = page.read_text(encoding="utf-8")
        for block in re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            found |= dict.fromkeys(block.splitlines(), page.name)
    return found


def copy_project(folder: Path, results: Path) -> None:
    """The project as somebody has it who cloned it, with the data that the texts speak of."""
    for name in COPIED:
        source = ROOT / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, folder / name)
    (folder / ".venv").symlink_to(sys.prefix)
    (folder / "out").mkdir()
    (folder / "out" / "fit_grab").symlink_to(results / "fit_grab")
    for name in ("part_aware.json", "animate.json"):
        shutil.copy(results / name, folder / name)
    stand_ins(folder)


def stand_ins(folder: Path) -> None:
    """Files in the places of licensed ones: the bundled body, its capture, meshes of it."""
    import numpy as np

    import xavatar_jax as xa
    from xavatar_jax.synthetic import write_synthetic_capture

    body = xa.synthetic_body()
    (folder / "MODELS" / "smplx").mkdir(parents=True)
    shutil.copy(body.source.path, folder / "MODELS" / "smplx" / "SMPLX_NEUTRAL.npz")
    write_synthetic_capture(folder / "AMASS" / "GRAB" / "s1", body)
    rng = np.random.default_rng(0)
    for sequence in ("walk", "wave"):
        (folder / "MY_FOLDER" / sequence).mkdir(parents=True)
        for k in range(8):
            pose = np.float32(0.1) * rng.standard_normal((body.num_joints, 3))
            params = xa.BodyParams.create(body, pose=pose)
            vertices = np.asarray(xa.pose_body(body, params).vertices)
            name = folder / "MY_FOLDER" / sequence / f"{k:04}"
            xa.write_ply(name.with_suffix(".ply"), xa.Mesh(vertices, np.asarray(body.faces)))
            names = ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose")
            names += ("left_hand_pose", "right_hand_pose", "transl", "betas")
            np.savez(
                name.with_suffix(".npz"),
                **{n: np.asarray(getattr(params, n)).reshape(-1) for n in names},
            )


def main() -> None:
    results = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_project(folder, results)
        environment = {**os.environ, "PYTHONPATH": str(folder / "src")}
        for command, page in commands().items():
            how = HOW.get(command, How(True))
            if not how.run:
                print(f"not here ({how.why_not}): {command}", flush=True)
                continue
            started = time.perf_counter()
            line = f"{command} {how.more}".strip()
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", line],
                cwd=folder,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            if done.returncode:
                sys.exit(f"{page}: {line}\n{done.stdout}\nstatus {done.returncode}")
            print(f"{time.perf_counter() - started:4.0f} s  {line}", flush=True)


if __name__ == "__main__":
    main()
