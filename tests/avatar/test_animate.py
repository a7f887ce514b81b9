"""Animation against the avatar's own meshes, frame by frame."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import xavatar_jax as xa
from xavatar_jax.avatar.animate import spread_frames
from xavatar_jax.body import SMPL_TREE
from xavatar_jax.geometry import closest_points


@pytest.fixture(scope="module")
def params(run) -> xa.BodyParams:
    rng = np.random.default_rng(5)
    frames = run.test.params
    return xa.BodyParams.create(
        run.body,
        pose=np.asarray(frames.pose),
        betas=np.asarray(frames.betas),
        expression=0.7 * rng.standard_normal((len(frames.pose), 10)),
        transl=np.asarray(frames.transl),
    )


def test_frames_lie_on_the_exact_surface(run, params):
    """Oracle: three Newton steps and weights read anew, as `mesh` does."""
    avatar = run.fit.avatar
    animation = avatar.animate(params)
    still = avatar.animate(params, offsets="none")
    for k in (0, 2):
        exact = avatar.mesh(params[k])
        distance = closest_points(exact.vertices, exact.faces, animation[k].vertices)[0]
        unmoved = closest_points(exact.vertices, exact.faces, still[k].vertices)[0]
        assert np.array_equal(animation[k].faces, exact.faces)
        assert distance.mean() < 1e-4
        assert distance.mean() < 0.4 * unmoved.mean()


def test_error_is_what_can_be_measured_from_outside(run, params):
    animation = run.fit.avatar.animate(params)
    found = animation.error(2)
    between, away = [], []
    for k in (0, 2):
        exact = run.fit.avatar.mesh(params[k])
        between.append(np.linalg.norm(animation[k].vertices - exact.vertices, axis=1))
        away.append(closest_points(exact.vertices, exact.faces, animation[k].vertices)[0])
    assert found.frames == 2
    assert found.vertex.mean == pytest.approx(1000 * np.mean(between), rel=1e-5)
    assert found.vertex.max == pytest.approx(1000 * np.max(between), rel=1e-5)
    assert found.vertex.p99 == pytest.approx(1000 * np.quantile(between, 0.99), rel=1e-5)
    assert found.surface.mean == pytest.approx(1000 * np.mean(away), rel=1e-5)
    assert found.surface.mean <= found.vertex.mean


def test_exact_offsets_are_the_meshes(run, params):
    animation = run.fit.avatar.animate(params, offsets="exact")
    expected = run.fit.avatar.mesh(params[1])
    np.testing.assert_array_equal(animation[1].vertices, expected.vertices)
    assert animation.error(1).vertex.max == 0


def test_without_offsets_the_neutral_surface_is_skinned(run, params):
    avatar = run.fit.avatar
    neutral = avatar.canonical_mesh(xa.canonical_params(run.body, jnp.asarray(avatar.betas)))
    own = xa.BodyParams.create(
        run.body,
        pose=params.pose[0],
        betas=avatar.betas,
        expression=params.expression[0],
        transl=params.transl[0],
    )
    weights = np.asarray(avatar.skin_weights(jnp.asarray(neutral.vertices)), np.float64)
    moves = np.asarray(xa.bone_transforms(run.body, own), np.float64)
    blended = np.einsum("vj,jab->vab", weights, moves)
    expected = np.einsum("vab,vb->va", blended[:, :3, :3], neutral.vertices) + blended[:, :3, 3]
    found = avatar.animate(params, offsets="none").frame_vertices(0)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_chunks_vertices_and_meshes_are_the_same_frames(run, params):
    animation = run.fit.avatar.animate(params)
    chunks = list(animation.chunks(2))
    assert [len(c) for c in chunks] == [2, 1]
    together = animation.vertices()
    assert together.shape == (3, len(run.fit.avatar.canonical_mesh().vertices), 3)
    assert together.dtype == np.float32
    np.testing.assert_array_equal(np.concatenate(chunks), together)
    for mesh, vertices in zip(animation, together, strict=True):
        np.testing.assert_array_equal(mesh.vertices, vertices)
        assert mesh.faces is animation.faces
    np.testing.assert_array_equal(animation[-1].vertices, together[2])
    with pytest.raises(IndexError, match="frame 3 of 3"):
        animation[3]
    with pytest.raises(ValueError, match="at least one"):
        next(animation.chunks(0))


def test_a_frame_does_not_depend_on_the_others(run, params):
    alone = run.fit.avatar.animate(params[1])
    assert len(alone) == 1
    among = run.fit.avatar.animate(params)
    np.testing.assert_allclose(alone.frame_vertices(0), among.frame_vertices(1), atol=1e-6)


def test_a_motion_gives_parameters_and_frame_rate(run, params):
    motion = xa.Motion.from_params(
        jax.tree.map(lambda leaf: leaf, replace(params)), fps=12.5, source="reach.npz"
    )
    animation = run.fit.avatar.animate(motion)
    assert animation.fps == 12.5
    assert animation.source == "reach.npz"
    assert run.fit.avatar.animate(motion, fps=50).fps == 50
    assert run.fit.avatar.animate(params).fps == 30
    expected = run.fit.avatar.animate(params).frame_vertices(2)
    np.testing.assert_allclose(animation.frame_vertices(2), expected, atol=1e-5)


def test_full_mode_gives_meshes_of_their_own(run, params, monkeypatch):
    animation = run.fit.avatar.animate(params, mode="full")
    asked = []

    def mesh(self, frame, *, mode):
        asked.append((np.asarray(frame.transl), mode))
        return "mesh"

    monkeypatch.setattr(xa.Avatar, "surface", mesh)
    assert list(animation) == ["mesh"] * 3
    np.testing.assert_allclose(asked[1][0], params.transl[1])
    assert {mode for _, mode in asked} == {"full"}
    for use in (animation.vertices, animation.error, lambda: animation.faces):
        with pytest.raises(ValueError, match="its own faces"):
            use()


def test_sequences_have_one_topology(run, params, tmp_path):
    animation = run.fit.avatar.animate(params[:2])
    paths = animation.export_sequence(tmp_path / "ply", verbose=False)
    for k, path in enumerate(paths):
        read = trimesh.load(path, process=False)
        np.testing.assert_allclose(read.vertices, animation[k].vertices, atol=1e-6)
        np.testing.assert_array_equal(read.faces, animation.faces)


def test_bad_input_is_named(run, params):
    avatar = run.fit.avatar
    with pytest.raises(ValueError, match="unknown mode 'quick': fast, full"):
        avatar.animate(params, mode="quick")
    with pytest.raises(ValueError, match="unknown offsets 'some'"):
        avatar.animate(params, offsets="some")
    with pytest.raises(TypeError, match="found dict"):
        avatar.animate({"pose": params.pose})
    with pytest.raises(ValueError, match="frame rate -1"):
        avatar.animate(params, fps=-1)
    with pytest.raises(ValueError, match=r"parameters\.pose, frame 1 is not finite"):
        avatar.animate(replace(params, pose=params.pose.at[1, 3, 0].set(jnp.nan)))
    with pytest.raises(ValueError, match="at least one frame"):
        avatar.animate(params[:0])
    other = xa.BodyParams(
        pose=jnp.zeros((2, 24, 3)),
        betas=jnp.zeros((2, 10)),
        expression=jnp.zeros((2, 0)),
        transl=jnp.zeros((2, 3)),
        tree=SMPL_TREE,
    )
    with pytest.raises(ValueError, match="24 joints"):
        avatar.animate(other)


def test_spread_frames_reach_both_ends():
    assert spread_frames(10, 4).tolist() == [0, 3, 6, 9]
    assert spread_frames(3, 8).tolist() == [0, 1, 2]
    assert spread_frames(5, 1).tolist() == [0]
    with pytest.raises(ValueError, match="at least one"):
        spread_frames(5, 0)
