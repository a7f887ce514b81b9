"""The self-contained page: its arrays skinned in NumPy, and the page itself in a browser."""

from __future__ import annotations

import base64
import json
import re
import zlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import xavatar_jax as xa
from viewer.browser import open_browser
from xavatar_jax.render import Camera, render_mesh
from xavatar_jax.viewer import view_html

READY = "!!(window.avatar && avatar.state.drawn > 0)"


@pytest.fixture(scope="module")
def file(avatar, motion, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "avatar.html"
    view_html(path, avatar, motion, title="arms & <legs>")
    return path


@pytest.fixture(scope="module")
def page(file):
    with open_browser() as opened:
        opened.open(file.as_uri(), 640, 640)
        opened.wait_for(READY)
        yield opened


def read(text: str) -> tuple[dict, dict[str, np.ndarray]]:
    """What a page holds, read from its text."""
    described = re.search(r'<script type="application/json" id="manifest">(.*?)</script>', text)
    packed = re.search(r'<script type="text/plain" id="data">(.*?)</script>', text)
    manifest, blob = json.loads(described[1]), zlib.decompress(base64.b64decode(packed[1]))
    arrays = {
        name: np.frombuffer(blob, one["dtype"], int(np.prod(one["shape"])), one["offset"]).reshape(
            one["shape"]
        )
        for name, one in manifest["arrays"].items()
    }
    return manifest, arrays


def posed(manifest: dict, arrays: dict[str, np.ndarray], frame: int) -> np.ndarray:
    """Vertices of a frame, skinned as the page is meant to skin them."""
    points = np.asarray(manifest["low"]) + manifest["step"] * arrays["positions"].astype(float)
    starts = arrays["target_starts"]
    for e, weight in enumerate(arrays["coefficients"][frame]):
        own = slice(starts[e], starts[e + 1])
        moved = weight * arrays["target_steps"][e] * arrays["target_moves"][own].astype(float)
        points[arrays["target_vertices"][own]] += moved
    local = np.tile(np.eye(4), (len(manifest["parents"]), 1, 1))
    local[:, :3, :3] = Rotation.from_quat(arrays["rotations"][frame]).as_matrix()
    local[:, :3, 3] = arrays["translations"][frame]
    world = local.copy()
    for joint, parent in enumerate(manifest["parents"]):
        if parent >= 0:
            world[joint] = world[parent] @ local[joint]
    bones = world[:, :3] @ np.concatenate(
        [arrays["inverse_bind"], np.tile([[[0, 0, 0, 1.0]]], (len(world), 1, 1))], axis=1
    )
    weights = arrays["weights"] / arrays["weights"].sum(1, keepdims=True, dtype=float)
    blended = np.einsum("vk,vkij->vij", weights, bones[arrays["joints"]])
    return np.einsum("vij,vj->vi", blended[:, :, :3], points) + blended[:, :, 3]


def test_arrays_skin_to_the_animation(avatar, motion, file):
    manifest, arrays = read(file.read_text(encoding="utf-8"))
    plain = avatar.animate(motion)
    for frame in (0, 3, 6):
        away = np.linalg.norm(posed(manifest, arrays, frame) - plain.frame_vertices(frame), axis=1)
        # What is left are offsets that depend on pose, which a rig does not hold.
        assert np.median(away) < 1e-3
        assert away.mean() < 3e-3
    assert manifest["fps"] == 10.0
    assert manifest["frames"] == 7


def test_a_motion_with_z_up_stands_upright(avatar, motion, file):
    _, arrays = read(file.read_text(encoding="utf-8"))
    manifest, turned = read(view_html(None, avatar, motion.to_z_up(avatar.body)).text)
    for name in ("rotations", "translations"):
        np.testing.assert_allclose(turned[name], arrays[name], atol=1e-5)
    assert manifest["bounds"][4] - manifest["bounds"][1] > 1.4


def test_page_needs_nothing_from_elsewhere(file):
    text = file.read_text(encoding="utf-8")
    assert not re.search(r"https?://|\bimport\s*\(|\bfetch\s*\(|<link|\ssrc=", text)
    assert "<title>arms &amp; &lt;legs&gt;</title>" in text
    assert "{{" not in re.sub(r"\$\{\{", "", text)


def test_page_in_the_browser_shows_what_the_renderer_shows(avatar, motion, page):
    drawn = page.run("avatar.state.drawn")
    page.run("avatar.state.time = 5; avatar.state.shading = 'avatar'; avatar.redraw()")
    page.wait_for(f"avatar.state.drawn > {drawn}")
    view = page.run(
        "({eye: avatar.state.view.eye, target: avatar.state.target, fov: avatar.rig.fov})"
    )
    mesh = avatar.animate(motion)[5]
    camera = Camera.look_at(view["eye"], view["target"], fov=view["fov"])
    truth = render_mesh(mesh, camera, 640, background=None, shading="flat")[..., 3] > 127
    page.run(
        "for (const n of ['aside', 'footer', 'header']) document.querySelector(n).style.opacity = 0"
    )
    picture = page.picture().astype(int)
    page.run(
        "for (const n of ['aside', 'footer', 'header']) document.querySelector(n).style.opacity = 1"
    )
    # Skin is warm; ground and background are grey.
    shown = picture[..., 0] - picture[..., 2] > 12
    assert truth.sum() > 0.05 * truth.size
    assert (shown & truth).sum() / (shown | truth).sum() > 0.95
    assert page.console == []


def test_sliders_move_the_mesh_in_the_browser(page):
    before = page.picture().astype(int)
    names = page.run("avatar.rig.names")
    page.run(
        f"document.getElementById('joint').value = {names.index('left_shoulder')};"
        "const s = document.getElementById('slider-z'); s.value = 60;"
        "s.dispatchEvent(new Event('input'))"
    )
    after = page.wait_until(lambda p: (np.abs(p - before).max(-1) > 40).mean() > 0.005)
    changed = np.abs(after - before).max(-1) > 40
    # The person's left arm is on the right of the picture.
    assert changed[:, 320:].sum() > 4 * changed[:, :320].sum()
    page.run("document.getElementById('reset').click()")
    page.wait_until(lambda p: (np.abs(p - before).max(-1) > 40).mean() < 0.002)
    assert page.console == []


def test_weights_and_player_in_the_browser(page):
    page.run(
        "const c = document.getElementById('shading'); c.value = 'weights';"
        "c.dispatchEvent(new Event('change'))"
    )
    middle = (slice(200, 420), slice(260, 380))
    page.wait_until(lambda p: (np.ptp(p[middle].astype(int), axis=-1) > 90).mean() > 0.1)
    page.run("document.getElementById('frame').value = 0; avatar.state.time = 0")
    page.run("document.getElementById('play').click()")
    page.wait_for("avatar.state.time > 2.5")
    page.run("document.getElementById('play').click()")
    assert page.run("avatar.state.time === Math.round(avatar.state.time)")
    assert page.console == []


def test_notebooks_show_the_page_in_place(avatar):
    page = view_html(None, avatar)
    shown = page._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert shown.count('"') == 4
    assert page.path is None


def test_bad_paths_are_refused_and_leave_nothing(avatar, motion, tmp_path):
    with pytest.raises(ValueError, match=r"avatar\.glb: the page is HTML"):
        view_html(tmp_path / "avatar.glb", avatar, motion)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        view_html(tmp_path / "file" / "avatar.html", avatar, motion)
    kept = tmp_path / "kept.html"
    kept.write_text("before")
    with pytest.raises(TypeError, match="a motion"):
        view_html(kept, avatar, "walk.npz")  # type: ignore[arg-type]
    assert kept.read_text() == "before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "kept.html"]


def test_names_of_the_library():
    assert xa.view_html is view_html
