"""`xavatar convert` and `xavatar info`."""

from __future__ import annotations

import json
import os
import shutil
from importlib.metadata import version as installed

import numpy as np
import pytest

from xavatar_jax.report import machine


def test_there_and_back_through_bvh(call, motion_file, tmp_path):
    bvh, back = tmp_path / "bend.bvh", tmp_path / "back.npz"
    code, said, error = call("convert", motion_file, "--out", bvh, "--body", "bundled")
    assert (code, said) == (0, f"{bvh}: 7 frames, 30 per second\n")
    assert error.startswith("notice: ")
    assert "expression" in error
    code, *_ = call("convert", bvh, "--out", back, "--body", "bundled", "--quiet")
    assert code == 0
    with np.load(motion_file) as first, np.load(back) as last:
        np.testing.assert_allclose(last["poses"], first["poses"], atol=1e-6)
        np.testing.assert_allclose(last["trans"], first["trans"], atol=1e-6)


def test_rate_stretch_and_frame(call, motion_file, tmp_path):
    out = tmp_path / "a.npz"
    code, said, _ = call("convert", motion_file, "--out", out, "--fps", 60, "--start", 0.1)
    assert (code, said) == (0, f"{out}: 7 frames, 60 per second\n")
    with np.load(motion_file) as first, np.load(out) as last:
        assert last["mocap_frame_rate"] == 60
        np.testing.assert_allclose(last["poses"][::2], first["poses"][3:], atol=1e-6)
        between = 0.5 * (first["poses"][3] + first["poses"][4])
        np.testing.assert_allclose(last["poses"][1], between, atol=1e-6)
    one = tmp_path / "pose.pkl"
    code, said, _ = call("convert", motion_file, "--out", one, "--frame", 6, "--body", "bundled")
    assert (code, said) == (0, f"{one}: 1 frame, 30 per second\n")
    folder = tmp_path / "poses"
    code, *_ = call("convert", motion_file, "--out", folder, "--body", "bundled")
    assert code == 0
    assert sum(name.endswith(".pkl") for name in os.listdir(folder)) == 7
    code, *_ = call("convert", "bundled:lunge_and_throw", "--out", tmp_path / "b.npz", "--end", 1)
    assert code == 0


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["MOTION", "--out", "a.bvh"], "(On the command line: --body.)"),
        (["MOTION", "--out", "a.fbx"], "--read-as for MOTION, --format for --out"),
        (["MOTION", "--out", "a.npz", "--read-as", "bvh"], "not of the format bvh"),
        (["MOTION", "--out", "a.npz", "--file-fps", "-3"], "must be positive"),
        (["MOTION", "--out", "a.npz", "--frame", "7"], "frames 0 to 6"),
        (
            ["nan.npz", "--out", "a.npz"],
            "nan.npz: poses is not finite in 1 frames, first in frame 2",
        ),
        (["none.npz", "--out", "a.npz"], "none.npz"),
        (["MOTION", "--out", "nan.npz/a.npz"], "is not a folder"),
    ],
)
def test_wrong_motions(call, motion_file, tmp_path, monkeypatch, words, complaint):
    monkeypatch.chdir(tmp_path)
    with np.load(motion_file) as arrays:
        broken = dict(arrays)
    broken["poses"][2, 0] = np.nan
    np.savez("nan.npz", **broken)
    words = [motion_file if word == "MOTION" else word for word in words]
    code, said, error = call("convert", *words)
    assert (code, said) == (2, "")
    assert complaint in error
    assert "Traceback" not in error
    assert os.listdir() == ["nan.npz"]


def test_an_interrupt_while_writing_leaves_the_old_file(call, motion_file, tmp_path, monkeypatch):
    out = tmp_path / "a.npz"
    shutil.copy(motion_file, out)

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", stop)
    assert call("convert", motion_file, "--out", out)[0] == 130
    assert list(tmp_path.iterdir()) == [out]
    assert out.read_bytes() == motion_file.read_bytes()


def test_info_of_every_kind_of_file(call, avatar_file, motion_file, family_paths, tmp_path):
    code, said, _ = call("info", avatar_file)
    assert code == 0
    assert "avatar" in said
    assert "10 shape, 10 expression" in said
    code, said, _ = call("info", motion_file, "--json")
    facts = json.loads(said)
    assert (facts["kind"], facts["frames"], facts["up"]) == ("motion", 7, "z")
    assert facts["moving"] == 2
    code, said, _ = call("info", family_paths["smplh"], "--json")
    facts = json.loads(said)
    assert (facts["joints"], facts["vertices"]) == (52, 90)
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n")
    code, said, _ = call("info", mesh, "--json")
    assert json.loads(said) == {
        "kind": "mesh", "vertices": 3, "faces": 1, "size": "1.000 x 2.000 x 0.000",
    }  # fmt: skip


def test_info_of_this_machine(call, monkeypatch, tmp_path):
    (tmp_path / "xavatar_jax").mkdir()
    (tmp_path / "xavatar_jax" / "kept.npz").write_bytes(bytes(2_000_000))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setattr(machine, "nvidia_gpu_present", lambda: True)
    monkeypatch.setattr(machine, "_CUDA_PLUGINS", ())
    code, said, error = call("info", "--json")
    assert (code, error) == (0, "")
    facts = json.loads(said)
    assert facts["versions"]["jax"] == installed("jax")
    assert facts["devices"] == ["cpu: cpu"]
    assert facts["environment"]["OMP_NUM_THREADS"] == "3"
    assert facts["cache"]["size"] == "2.0 MB in 1 files"
    lines = [line for line in call("info")[1].splitlines() if line.startswith("GPU ")]
    assert len(lines) == 1
    assert 'pip install -e ".[gpu]"' in lines[0]


def test_advice_is_for_gpus_that_are_not_used(monkeypatch):
    monkeypatch.setattr(machine, "nvidia_gpu_present", lambda: True)
    assert machine.gpu_advice({"gpu"}) is None
    monkeypatch.setattr(machine, "_CUDA_PLUGINS", ("numpy",))  # something that is installed
    assert "does not start" in (machine.gpu_advice({"cpu"}) or "")
    monkeypatch.setattr(machine, "nvidia_gpu_present", lambda: False)
    assert machine.gpu_advice({"cpu"}) is None


def test_a_gpu_shows_by_its_device_or_its_tool(monkeypatch, tmp_path):
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\n")
    tool.chmod(0o755)
    monkeypatch.setattr(machine.Path, "exists", lambda self: False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert machine.nvidia_gpu_present()
    tool.unlink()
    assert not machine.nvidia_gpu_present()
    monkeypatch.setattr(machine.Path, "exists", lambda self: str(self) == "/dev/nvidia0")
    assert machine.nvidia_gpu_present()
