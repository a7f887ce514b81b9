"""The viewer: what its panel asks for, what it then shows, and the page in a browser."""

from __future__ import annotations

import sys
import time
import urllib.request

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import xavatar_jax as xa
from viewer.browser import open_browser
from xavatar_jax.body import facing
from xavatar_jax.frames import frames_from_params
from xavatar_jax.viewer.surfaces import (
    ERROR,
    NORMALS,
    TRUTH,
    WEIGHTS,
    Request,
    Surfaces,
    frame_of,
    joint_choices,
    turned,
)


@pytest.fixture(scope="module")
def frames(avatar, motion):
    return frames_from_params(avatar.body, motion.to_params(avatar.body))


@pytest.fixture(scope="module")
def surfaces(avatar, motion, frames):
    return Surfaces(avatar, motion.to_params(avatar.body), frames, np.array([0.0, 1.0, 0.0]), 5.0)


@pytest.fixture(scope="module")
def viewer(avatar, motion, frames):
    pytest.importorskip("viser", reason="no viser: pip install -e '.[view]'")
    with xa.view(avatar, motion, frames, port=8470, verbose=False) as opened:
        opened.wait_until_shown(120)
        yield opened


def test_turns_act_before_the_frames_own_rotation(avatar, motion):
    own = frame_of(motion.to_params(avatar.body), 3)
    turn = np.array([0.3, -0.2, 0.5])
    found = turned(own, {16: turn}, np.full(10, 0.5))
    expected = Rotation.from_rotvec(own.pose[16]) * Rotation.from_rotvec(turn)
    np.testing.assert_allclose(found.pose[16], expected.as_rotvec(), atol=1e-6)
    np.testing.assert_allclose(np.delete(found.pose, 16, 0), np.delete(own.pose, 16, 0), atol=1e-6)
    np.testing.assert_allclose(found.expression, np.asarray(own.expression) + 0.5, atol=1e-6)


def test_every_joint_can_be_turned(avatar):
    groups = joint_choices(avatar.body.tree)
    assert set(groups) == {"Body", "Left hand", "Right hand", "Jaw and eyes"}
    reached = {j for choices in groups.values() for joints in choices.values() for j in joints}
    assert reached == set(range(55))
    assert len(groups["Left hand"]["all fingers"]) == 12


def test_facing_follows_the_root(avatar):
    params = xa.BodyParams.create(avatar.body, global_orient=[0.0, np.pi / 2, 0.0])
    np.testing.assert_allclose(facing(params), [1, 0, 0], atol=1e-6)


def test_surface_of_a_frame_is_that_of_the_animation(avatar, motion, surfaces):
    expected = avatar.animate(motion).frame_vertices(4)
    shown = surfaces(Request(frame=4))
    np.testing.assert_allclose(shown.vertices, expected, atol=1e-5)
    stays = surfaces(Request(frame=4, in_place=True))
    np.testing.assert_allclose(
        stays.vertices, expected - motion.transl[4] + motion.transl[0], atol=1e-5
    )


def test_a_turned_elbow_moves_that_forearm_alone(surfaces):
    names = surfaces.avatar.body.tree.names
    rest = surfaces(Request()).vertices
    bent = surfaces(Request(turns=((names.index("left_elbow"), (0.0, 1.0, 0.0)),))).vertices
    moved = np.linalg.norm(bent - rest, axis=1) > 0.01
    # In the rest pose the person's left arm points along +x.
    assert moved.any()
    assert rest[moved, 0].min() > 0.2
    assert moved[rest[:, 0] > 0.5].all()


def test_colours_say_weights_normals_and_distance(surfaces):
    arm = surfaces.avatar.body.tree.names.index("left_elbow")
    colors = surfaces(Request(shading=WEIGHTS, bone=arm)).colors.astype(int)
    rest = surfaces(Request()).vertices
    assert np.ptp(colors[rest[:, 0] < 0], axis=0).max() < 10
    assert (colors[rest[:, 0] > 0][:, 0] - colors[rest[:, 0] > 0][:, 2]).max() > 120
    assert surfaces(Request(shading=NORMALS)).colors.shape == rest.shape
    wrong = surfaces(Request(frame=2, shading=ERROR))
    distance = float(wrong.note.split(" mm")[0].split()[-1])
    vertices, truth = wrong.vertices, surfaces.frames[2].vertices
    nearest = np.linalg.norm(vertices[::50, None] - truth[None], axis=2).min(1)
    assert 0 < distance < 1000 * nearest.mean() * 1.3
    shown = surfaces(Request(frame=2, shading=TRUTH))
    np.testing.assert_array_equal(shown.vertices, truth)


def test_page_shows_the_avatar_and_its_sliders_move_it(viewer):
    with open_browser() as page:
        page.open(viewer.url, 900, 640)
        left = (slice(None), slice(200, 560))

        def has_person(picture: np.ndarray) -> bool:
            part = picture[left].astype(int)
            return bool((part[..., 0] - part[..., 2] > 15).mean() > 0.03)

        before = page.wait_until(has_person).astype(int)
        slider = "[...document.querySelectorAll('[role=slider]')][0]"
        page.wait_for(f"!!{slider}")
        page.run(f"{slider}.focus()")
        for _ in range(6):
            for kind in ("keyDown", "keyUp"):
                page.send(
                    "Input.dispatchKeyEvent", type=kind, key="ArrowRight", code="ArrowRight",
                    windowsVirtualKeyCode=39,
                )  # fmt: skip
        end = time.monotonic() + 30
        while viewer.panel.frame.value != 6 and time.monotonic() < end:
            time.sleep(0.05)
        assert viewer.panel.frame.value == 6
        page.wait_until(lambda p: (np.abs(p[left] - before[left]).max(-1) > 40).mean() > 0.01)
        viewer.panel.shading.value = WEIGHTS
        page.wait_until(lambda p: (np.ptp(p[left].astype(int), axis=-1) > 90).mean() > 0.01)
        assert page.console == []
    viewer.panel.shading.value = "avatar"


def test_player_loops_over_the_frames(viewer):
    viewer.panel.frame.value = 0
    viewer.panel.playing.value = True
    seen, end = set(), time.monotonic() + 30
    while len(seen) < 4 and time.monotonic() < end:
        seen.add(int(viewer.panel.frame.value))
        time.sleep(0.02)
    viewer.panel.playing.value = False
    assert len(seen) >= 4
    assert seen <= set(range(7))


def test_panel_asks_for_what_its_sliders_say(viewer):
    viewer.panel.set_turn(16, (0.0, 0.0, 30.0))
    assert viewer.panel.request().turns == ((16, (0.0, 0.0, pytest.approx(np.pi / 6))),)
    viewer.panel.reset()
    assert viewer.panel.request().turns == ()


def test_viewer_answers_this_machine_and_notebooks_show_it(viewer):
    with urllib.request.urlopen(viewer.url, timeout=30) as answer:
        assert answer.status == 200
    assert f'src="{viewer.url}"' in viewer._repr_html_()


def test_frames_must_fit_the_motion(avatar, motion, frames):
    pytest.importorskip("viser", reason="no viser: pip install -e '.[view]'")
    with pytest.raises(ValueError, match="5 frames of ground truth for a motion of 7"):
        xa.view(avatar, motion, frames[:5], verbose=False)


def test_without_viser_the_extra_is_named(avatar, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r'pip install -e "\.\[view\]"'):
        xa.view(avatar)
