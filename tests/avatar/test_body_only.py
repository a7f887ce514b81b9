"""Body-only skeletons: what is cut, where its weights go, and how frames are mapped."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE, TREES

import xavatar_jax as xa
from xavatar_jax.avatar import (
    Avatar,
    BodyOnlyAvatar,
    Drivable,
    body_only,
    body_only_frames,
    body_only_params,
    kept_joints,
)
from xavatar_jax.body import canonical_pose, pose_body
from xavatar_jax.fields import GeometrySpec, MLPShape, ModelSpec, SkinningSpec, build_model
from xavatar_jax.frames import Frames
from xavatar_jax.kinematics import KinematicTree

WHOLE = ("smplx", "smplh", "smpl")


def posed(body, rng, *, only=None, batch=()):
    """Random parameters; joints that are not in `only` do not turn."""
    pose = 0.4 * rng.standard_normal((*batch, body.num_joints, 3))
    if only is not None:
        pose[..., [j for j in range(body.num_joints) if j not in only], :] = 0
    coefficients = {
        "betas": rng.standard_normal((*batch, 4)),
        "transl": rng.standard_normal((*batch, 3)),
    }
    if body.num_expression:
        coefficients["expression"] = rng.standard_normal((*batch, 3))
    return xa.BodyParams.create(body, pose=pose, **coefficients)


@pytest.mark.parametrize("kind", WHOLE)
def test_the_body_joints_of_the_family_stay(kind):
    assert kept_joints(TREES[kind]) == tuple(range(22))


def test_what_hangs_below_wrists_and_head_is_cut_on_any_tree():
    names = ("root", "left_wrist", "head", "palm", "tail", "tongue", "tip")
    tree = KinematicTree(names, (-1, 0, 0, 1, 0, 2, 3))
    assert [tree.names[j] for j in kept_joints(tree)] == ["root", "left_wrist", "head", "tail"]
    other = KinematicTree(("a", "b", "c"), (-1, 0, 1))
    assert kept_joints(other) == (0, 1, 2)


@pytest.mark.parametrize("kind", WHOLE)
def test_vertices_are_the_whole_bodys_where_what_was_cut_rests(family, kind, rng):
    body = family[kind]
    cut = body_only(body)
    params = posed(body, rng, only=kept_joints(body.tree))
    own = body_only_params(cut, params)
    # The expression is dropped, so the whole body is asked without one.
    still = xa.BodyParams.create(body, pose=params.pose, betas=params.betas, transl=params.transl)
    expected = pose_body(body, still)
    found = pose_body(cut, own)
    np.testing.assert_allclose(found.vertices, expected.vertices, atol=TOLERANCE["body_m"])
    np.testing.assert_allclose(found.joints, expected.joints[:22], atol=TOLERANCE["body_m"])


def test_weights_go_to_the_nearest_joint_that_stays(family):
    body = family["smplx"]
    cut, whole = body_only(body), np.asarray(body.weights, np.float64)
    found = np.asarray(cut.weights, np.float64)
    np.testing.assert_allclose(found.sum(1), 1, atol=TOLERANCE["sum_to_one"])
    for name, members in (
        ("left_wrist", [20, *range(25, 40)]),
        ("right_wrist", [21, *range(40, 55)]),
        ("head", [15, 22, 23, 24]),
        ("left_knee", [4]),
    ):
        own = found[:, cut.tree.index(name)]
        np.testing.assert_allclose(own, whole[:, members].sum(1), atol=TOLERANCE["sum_to_one"])


def test_canonical_space_and_source(family):
    body = family["smplx"]
    cut = body_only(body)
    expected = np.asarray(canonical_pose(body))[:22]
    np.testing.assert_array_equal(canonical_pose(cut), expected)
    assert cut.source.checksum != body.source.checksum
    assert (cut.num_expression, cut.num_betas) == (0, body.num_betas)


def test_a_hand_is_not_a_body(family):
    with pytest.raises(ValueError, match="needs a body"):
        body_only(family["mano"])


def test_frames_keep_their_meshes_and_lose_what_is_cut(family, rng):
    body = family["smplx"]
    cut = body_only(body)
    params = posed(body, rng, batch=(3,))
    meshes = [
        (np.asarray(pose_body(body, params[k]).vertices), np.asarray(body.faces)) for k in range(3)
    ]
    frames = Frames.from_meshes(meshes, params, sources=("a", "b", "c"), body=body)[[2, 0]]
    found = body_only_frames(cut, frames)
    assert found.body is cut
    assert found.sources == ("c", "a")
    np.testing.assert_array_equal(found[0].vertices, frames[0].vertices)
    np.testing.assert_array_equal(found.params.pose, np.asarray(params.pose)[[2, 0], :22])
    np.testing.assert_array_equal(found.params.betas, frames.params.betas)
    assert found.params.expression.shape == (2, 0)
    assert frames.body is body
    with pytest.raises(ValueError, match="parameters for 1 frames; there are 2"):
        frames.with_params(frames.params[:1])


def test_parameters_of_another_tree_are_refused(family, rng):
    cut = body_only(family["smplx"])
    with pytest.raises(ValueError, match="16 joints, of which 1 stay"):
        body_only_params(cut, posed(family["mano"], rng))


def test_an_avatar_takes_parameters_of_the_whole_body(family, rng, monkeypatch):
    body = family["smplx"]
    cut = body_only(body)
    tiny = MLPShape(width=8, depth=1, octaves=0, skip=(), condition_at=())
    spec = ModelSpec(SkinningSpec(kind="mlp", mlp=tiny), GeometrySpec(kind="mlp", mlp=tiny))
    model = build_model(spec, cut, key=jax.random.key(0))
    betas = rng.standard_normal(4).astype(np.float32)
    avatar = BodyOnlyAvatar(body, Avatar(cut, betas, model, spec, steps=7, method="snarf"))
    asked, made = [], xa.Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))

    def mesh(self, params, *, mode):
        asked.append((params, mode))
        return made

    monkeypatch.setattr(Avatar, "mesh", mesh)
    params = posed(body, rng)
    assert avatar.surface(params, mode="full") is made
    np.testing.assert_array_equal(asked[0][0].pose, params.pose[:22])
    assert asked[0][1] == "full"
    own = xa.BodyParams.create(
        body, pose=params.pose, betas=jnp.asarray(betas), transl=params.transl,
        expression=params.expression,
    )  # fmt: skip
    np.testing.assert_allclose(
        avatar.posed_template(params), pose_body(body, own).vertices, atol=TOLERANCE["body_m"]
    )
    assert isinstance(avatar, Drivable)
    assert not isinstance(avatar, Avatar)
    assert (avatar.steps, avatar.method) == (7, "snarf")
