"""`xavatar export` and `xavatar animate`: files, errors, and nothing half-written."""

from __future__ import annotations

import errno
import json
import os

import numpy as np
import pytest
import trimesh
from PIL import Image

import xavatar_jax as xa
from xavatar_jax.files import load_arrays, save_arrays

pytestmark = pytest.mark.usefixtures("coarse")


def gltf_json(path) -> dict:
    """The JSON chunk of a GLB file: bytes 12 to 20 hold its length and kind."""
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_a_glb_has_a_clip_for_every_motion(call, avatar_file, motion_file, tmp_path):
    out = tmp_path / "avatar.glb"
    code, said, _ = call(
        *("export", avatar_file, motion_file, motion_file, "--out", out),
        *("--expressions", 3, "--influences", 8),
    )
    assert code == 0
    assert "8 influences" in said
    document = gltf_json(out)
    assert [clip["name"] for clip in document["animations"]] == ["bend", "bend_2"]
    names = document["meshes"][0]["extras"]["targetNames"]
    assert names == [f"expression_{k}_{side}" for side in ("plus", "minus") for k in range(3)]
    assert "JOINTS_1" in document["meshes"][0]["primitives"][0]["attributes"]


def test_the_name_says_what_is_written(call, avatar_file, motion_file, tmp_path):
    for name, words in (
        ("neutral.ply", ()),
        ("bent.obj", (motion_file, "--frame", 6)),
        ("straight.ply", (motion_file,)),
    ):
        code, said, _ = call("export", avatar_file, *words, "--out", tmp_path / name)
        assert code == 0
        assert "vertices" in said
    neutral, bent, straight = (
        trimesh.load_mesh(tmp_path / n, process=False)
        for n in ("neutral.ply", "bent.obj", "straight.ply")
    )
    assert len(neutral.vertices) == len(bent.vertices) == len(straight.vertices)
    assert np.abs(bent.vertices - straight.vertices).max() > 1e-3

    folder = tmp_path / "frames"
    code, said, _ = call("export", avatar_file, motion_file, "--out", folder, "--fps", 15)
    assert (code, sorted(os.listdir(folder))) == (0, [f"frame_{k:04d}.ply" for k in range(4)])
    assert "4 meshes" in said

    code, *_ = call("export", avatar_file, "--out", tmp_path / "weights.npz", "--quiet")
    with np.load(tmp_path / "weights.npz") as arrays:
        np.testing.assert_allclose(arrays["weights"].sum(1), 1, atol=1e-5)
        assert arrays["weights"].shape == (len(neutral.vertices), 55)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--out", "a.fbx"], "unknown format .fbx"),
        (["MOTION", "--out", "a.npz"], "leave out MOTION"),
        (["--out", "folder"], "needs one MOTION, found"),
        (["MOTION", "MOTION", "--out", "a.ply"], "needs one MOTION, found"),
        (["--frame", "3", "--out", "a.ply"], "--frame applies to one mesh"),
        (["MOTION", "--frame", "7", "--out", "a.ply"], "frames 0 to 6"),
        (["MOTION", "--fps", "-1", "--out", "a.glb"], "must be positive"),
        (["--expressions", "11", "--out", "a.glb"], "has 10 coefficients"),
        (["--out", "there/file/a.glb"], "is not a folder"),
        (["--out", "there"], "already exists"),
        (["MOTION", "--out", "there"], "already exists"),
        (["--out", "there.glb"], "this is a folder; give a file name"),
    ],
)  # fmt: skip
def test_what_cannot_be_written_is_said_first(
    call, avatar_file, motion_file, tmp_path, monkeypatch, words, complaint
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("kept")
    (tmp_path / "there.glb").mkdir()
    before = sorted(tmp_path.rglob("*"))
    if words == ["--out", "there"]:
        complaint = "needs one MOTION, found"
    words = [motion_file if word == "MOTION" else word for word in words]
    code, said, error = call("export", avatar_file, *words)
    assert (code, said) == (2, "")
    assert error.startswith("error: ")
    assert complaint in error
    assert sorted(tmp_path.rglob("*")) == before


def test_a_folder_that_takes_no_files(call, avatar_file, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    code, _, error = call("export", avatar_file, "--out", tmp_path / "a.glb")
    assert code == 2
    assert f"because {tmp_path} is not writable" in error


@pytest.mark.parametrize(("failure", "code"), [
    (KeyboardInterrupt(), 130),
    (OSError(errno.ENOSPC, "No space left on device", "disk"), 1),
    (RuntimeError("out of luck"), 1),
])  # fmt: skip
@pytest.mark.parametrize("name", ["avatar.glb", "frames"])
def test_an_export_that_ends_early_leaves_nothing(
    call, avatar_file, motion_file, tmp_path, monkeypatch, name, failure, code
):
    from xavatar_jax.avatar import Animation

    seen = []

    def stop(self, index):
        seen.append(index)
        if len(seen) == 2:
            raise failure
        return vertices(self, index)

    vertices = Animation.frame_vertices
    monkeypatch.setattr(Animation, "frame_vertices", stop)
    out = tmp_path / name
    if name == "avatar.glb":
        out.write_bytes(b"what stood here before")
    found, said, error = call("export", avatar_file, motion_file, "--out", out)
    assert (found, said) == (code, "")
    assert "Traceback" not in error
    assert len(error.strip().splitlines()) == 1
    if name == "avatar.glb":
        assert out.read_bytes() == b"what stood here before"
        out.unlink()
    assert list(tmp_path.iterdir()) == []


def test_an_avatar_of_a_newer_version(call, avatar_file, tmp_path):
    arrays, header = load_arrays(avatar_file)
    newer = tmp_path / "newer.npz"
    save_arrays(newer, arrays, {**header, "format": 9, "version": "7.0"})
    for command in ("export", "info"):
        words = ("--out", tmp_path / "a.glb") if command == "export" else ()
        code, _, error = call(command, newer, *words)
        assert code == 2
        assert "written by xavatar_jax 7.0 in format 9" in error
    assert list(tmp_path.iterdir()) == [newer]


def test_files_that_are_something_else(call, avatar_file, motion_file, tmp_path):
    strange = tmp_path / "strange.dat"
    strange.write_bytes(b"nothing that anybody knows")
    out = ("--out", tmp_path / "a.glb")
    code, _, error = call("export", avatar_file, strange, *out)
    assert code == 2
    assert "strange.dat: not recognised as a motion" in error
    code, _, error = call("export", motion_file, *out)
    assert code == 2
    assert "so xavatar_jax did not write it" in error
    code, _, error = call("export", tmp_path / "missing.npz", *out)
    assert code == 2
    assert "missing.npz" in error
    code, _, error = call("export", avatar_file, "bundled:nothing", *out)
    assert code == 2
    assert "there are inspect_and_pass" in error


def test_another_body_is_refused(call, avatar_file, family_paths, tmp_path):
    arrays, header = load_arrays(avatar_file)
    moved = tmp_path / "moved.npz"
    header["body"]["path"] = "/nowhere/SMPLX_NEUTRAL.npz"
    save_arrays(moved, arrays, header)
    out = ("--out", tmp_path / "weights.npz")
    code, _, error = call("export", moved, *out)
    assert code == 2
    assert error.rstrip().endswith("(On the command line: --body.)")
    code, _, error = call("export", moved, "--body", family_paths["smplx"], *out)
    assert code == 2
    assert "fitted on another body" in error
    code, *_ = call("export", moved, "--body", "bundled", *out)
    assert code == 0


@pytest.mark.parametrize(("name", "count"), [("a.webp", 7), ("a.gif", 7), ("pictures", 4)])
def test_pictures_of_every_frame(call, avatar_file, motion_file, tmp_path, name, count):
    out = tmp_path / name
    rate = ("--fps", 15) if name == "pictures" else ()
    code, said, error = call(
        *("animate", avatar_file, motion_file, "--out", out, "--size", 48, 40, *rate)
    )
    assert (code, error) == (0, "")
    assert f"{count} frames" in said
    if out.is_dir():
        assert sorted(os.listdir(out)) == [f"frame_{k:04d}.png" for k in range(count)]
        out = out / "frame_0000.png"
    with Image.open(out) as first:
        if name != "pictures":
            assert 1 < first.n_frames <= count
        assert first.size == (48, 40)
        assert np.asarray(first.convert("RGB")).std() > 5


def test_pictures_that_end_early_leave_nothing(
    call, avatar_file, motion_file, tmp_path, monkeypatch
):
    from xavatar_jax.report import pictures

    def stop(*_, **__):
        for _ in range(2):
            yield np.zeros((4, 4, 3), np.uint8)
        assert len(list(tmp_path.glob(".*/*.png"))) == 2
        raise KeyboardInterrupt

    monkeypatch.setattr(pictures, "render_sequence", stop)
    code, _, error = call("animate", avatar_file, motion_file, "--out", tmp_path / "new")
    assert (code, error.strip()) == (130, "stopped; no file was left incomplete.")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--out", "a.mp4"], "ffmpeg"),
        (["--out", "a.webp", "--size", "0", "4"], "must be at least one pixel"),
        (["--out", "a.webp", "--start", "9"], "seconds"),
        (["--out", "a.webp", "--fps", "nan"], "must be positive"),
    ],
)
def test_pictures_that_cannot_be_drawn(
    call, avatar_file, motion_file, tmp_path, monkeypatch, words, complaint
):
    monkeypatch.chdir(tmp_path)
    code, _, error = call("animate", avatar_file, motion_file, *words)
    assert code == 2
    assert complaint in error
    assert list(tmp_path.iterdir()) == []


def test_fewer_expressions_are_the_first_ones(avatar_file, coarse, tmp_path):
    from xavatar_jax.avatar.rigging import build_rig, expression_scales

    avatar = xa.load_avatar(avatar_file)
    every = build_rig(avatar, expression_scales(avatar, []))
    two = build_rig(avatar, expression_scales(avatar, [], 2))
    assert len(two.targets) == 4
    np.testing.assert_allclose(two.targets, every.targets[[0, 1, 10, 11]], atol=1e-7)
    assert expression_scales(avatar, [], False) is None
    assert len(expression_scales(avatar, [], 0)) == 0
