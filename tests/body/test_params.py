"""Parameters by SMPL-X's names: shapes, broadcasting, views, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TREES

from xavatar_jax.body import BodyParams, check_params

# Joints behind each name in SMPL-X's own order, typed here.
SMPLX_GROUPS = {
    "global_orient": [0],
    "body_pose": list(range(1, 22)),
    "jaw_pose": [22],
    "leye_pose": [23],
    "reye_pose": [24],
    "left_hand_pose": list(range(25, 40)),
    "right_hand_pose": list(range(40, 55)),
}


@pytest.mark.parametrize("flat", [True, False], ids=["flat", "by_joint"])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_each_name_sets_and_views_its_own_joints(family, rng, flat, batch):
    for name, joints in SMPLX_GROUPS.items():
        value = rng.normal(size=(*batch, len(joints), 3)).astype(np.float32)
        given = value.reshape(*batch, -1) if flat else value
        params = BodyParams.create(family["smplx"], **{name: given})
        assert params.pose.shape == (*batch, 55, 3)
        assert params.batch_shape == batch
        np.testing.assert_array_equal(params.pose[..., joints, :], value)
        others = [j for j in range(55) if j not in joints]
        assert not np.asarray(params.pose[..., others, :]).any()
        view = getattr(params, name)
        np.testing.assert_array_equal(np.asarray(view).reshape(value.shape), value)


def test_batches_broadcast(family, rng):
    body = family["smplx"]
    params = BodyParams.create(
        body,
        body_pose=rng.normal(size=(5, 63)),
        jaw_pose=np.array([0.1, 0.0, 0.0]),
        betas=rng.normal(size=(1, 4)),
        transl=rng.normal(size=(5, 3)),
    )
    assert params.pose.shape == (5, 55, 3)
    assert params.betas.shape == (5, 4)
    assert params.expression.shape == (5, 10)
    np.testing.assert_allclose(params.jaw_pose[:, 0, 0], 0.1, rtol=1e-6)
    assert len(params) == 5
    assert params[2].pose.shape == (55, 3)
    assert params[1:3].betas.shape == (2, 4)
    assert params[np.array([4, 0])].transl.shape == (2, 3)
    np.testing.assert_array_equal(params[4].transl, params.transl[4])
    with pytest.raises(ValueError, match="broadcast"):
        BodyParams.create(body, body_pose=np.zeros((5, 63)), transl=np.zeros((4, 3)))


def test_a_single_frame_has_no_length(family):
    params = BodyParams.zeros(family["smpl"])
    with pytest.raises(TypeError, match="single frame"):
        len(params)
    with pytest.raises(IndexError, match="single frame"):
        params[0]
    assert len(BodyParams.zeros(family["smpl"], (3,))) == 3


@pytest.mark.parametrize(
    ("kind", "joints", "absent"),
    [
        ("smpl", 23, ("left_hand_pose", "right_hand_pose", "jaw_pose", "leye_pose", "reye_pose")),
        ("smplh", 21, ("jaw_pose", "leye_pose", "reye_pose")),
        ("mano", 0, ("left_hand_pose", "jaw_pose", "leye_pose", "reye_pose", "body_pose")),
    ],
)
def test_trees_without_hands_jaw_or_body(family, kind, joints, absent):
    params = BodyParams.zeros(family[kind], (2,))
    assert params.body_pose.shape == (2, joints, 3)
    for name in absent:
        assert getattr(params, name).shape == (2, 0, 3)
        with pytest.raises(ValueError, match=f"{name} was given, but .* no such joints"):
            BodyParams.create(family[kind], **{name: np.zeros(3)})
    named = 1 + sum(getattr(params, name).shape[1] for name in SMPLX_GROUPS if name[:3] != "glo")
    assert named == TREES[kind].num_joints  # the names cover the tree


def test_whole_pose(family, rng):
    pose = rng.normal(size=(2, 24, 3))
    for given in (pose, pose.reshape(2, 72)):
        params = BodyParams.create(family["smpl"], pose=given)
        np.testing.assert_allclose(params.pose, pose, rtol=1e-6)
    with pytest.raises(ValueError, match="leave out body_pose"):
        BodyParams.create(family["smpl"], pose=pose, body_pose=pose[:, 1:])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"body_pose": np.zeros(69)}, r"body_pose has shape \(69,\), expected .*63.*21, 3"),
        ({"body_pose": np.zeros((4, 23, 3))}, r"body_pose has shape \(4, 23, 3\)"),
        ({"jaw_pose": np.zeros(4)}, r"jaw_pose has shape \(4,\)"),
        ({"left_hand_pose": np.zeros(12)}, r"left_hand_pose has shape \(12,\).*45"),
        ({"pose": np.zeros((24, 3))}, r"pose has shape \(24, 3\), expected .*165.*55, 3"),
        ({"global_orient": 0.0}, r"global_orient has shape \(\)"),
        ({"betas": 1.0}, "betas is a single number"),
        ({"betas": np.zeros(301)}, "betas has 301 coefficients, but the body .* has 300"),
        ({"expression": np.zeros(101)}, "expression has 101 coefficients, but .* has 100"),
        ({"transl": np.zeros(2)}, r"transl has shape \(2,\), expected"),
    ],
)
def test_wrong_shapes_name_argument_and_shapes(family, arguments, message):
    with pytest.raises(ValueError, match=message):
        BodyParams.create(family["smplx"], **arguments)


def test_parameters_are_a_pytree(family, rng):
    body = family["smplh"]
    params = BodyParams.create(body, pose=rng.normal(size=(3, 52, 3)))
    assert len(jax.tree.leaves(params)) == 4
    doubled = jax.jit(jax.vmap(lambda p: jax.tree.map(lambda x: 2 * x, p)))(params)
    np.testing.assert_allclose(doubled.pose, 2 * params.pose)
    assert doubled.tree == body.tree
    gradient = jax.grad(lambda p: jnp.sum(p.left_hand_pose**2))(params[0])
    np.testing.assert_allclose(gradient.pose[22:37], 2 * params.pose[0, 22:37], rtol=1e-6)
    assert not np.asarray(gradient.pose[:22]).any()


@pytest.mark.parametrize("name", ["pose", "betas", "expression", "transl"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_name_field_and_frame(family, rng, name, value):
    body = family["smplx"]
    params = BodyParams.create(body, pose=rng.normal(size=(4, 55, 3)))
    check_params(body, params)
    broken = np.array(getattr(params, name))
    broken[2].flat[1] = value
    with pytest.raises(ValueError, match=rf"motion\.{name}, frame 2 is not finite"):
        check_params(body, replace(params, **{name: jnp.asarray(broken)}), what="motion")
    with pytest.raises(ValueError, match=rf"params\.{name} is not finite"):
        check_params(body, replace(params, **{name: jnp.asarray(broken)})[2])


def test_parameters_of_another_body_are_refused(family):
    with pytest.raises(ValueError, match=r"tree of 24 joints; the body .* has 55"):
        check_params(family["smplx"], BodyParams.zeros(family["smpl"]))
    params = BodyParams.create(family["smplx"], betas=np.zeros(20))
    smaller = replace(params, betas=jnp.zeros(301))
    with pytest.raises(ValueError, match=r"params\.betas has shape \(301,\).*300"):
        check_params(family["smplx"], smaller)
