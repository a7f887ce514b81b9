"""The bundled body in SMPL-X layout, posed by an independent implementation: `body-models`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE

from xavatar_jax.body import BodyParams, load_body, pose_body


@pytest.fixture(scope="module")
def oracle(bundled_body):
    smplx = pytest.importorskip("body_models.smplx.jax", reason="needs the package body-models")
    return smplx.SMPLX(model_path=bundled_body.source.path, flat_hand_mean=True)


def oracle_arguments(params):
    """Its names for our parameters: unbatched or batched alike."""
    return {
        "body_pose": params.body_pose,
        "head_pose": jnp.concatenate([params.jaw_pose, params.leye_pose, params.reye_pose], -2),
        "hand_pose": jnp.concatenate([params.left_hand_pose, params.right_hand_pose], -2),
        "pelvis_rotation": params.global_orient,
        "shape": params.betas,
        "expression": params.expression,
        "global_translation": params.transl,
    }


def random_params(body, seed, count, spread=0.4):
    rng = np.random.default_rng(seed)
    return BodyParams.create(
        body,
        global_orient=rng.normal(size=(count, 3)),
        body_pose=spread * rng.normal(size=(count, 63)),
        left_hand_pose=spread * rng.normal(size=(count, 45)),
        right_hand_pose=spread * rng.normal(size=(count, 45)),
        jaw_pose=[0.2, 0.0, 0.05] * np.ones((count, 1)),
        leye_pose=0.2 * rng.normal(size=(count, 3)),
        reye_pose=0.2 * rng.normal(size=(count, 3)),
        betas=rng.normal(size=(count, 10)),
        expression=rng.normal(size=(count, 10)),
        transl=rng.normal(size=(count, 3)),
    )


def test_vertices_and_joints_agree(bundled_body, oracle):
    params = random_params(bundled_body, 0, 4)
    rest = jax.tree.map(lambda leaf: leaf.at[0].set(0), params)  # the first frame is the rest pose
    params = jax.tree.map(lambda a, b: jnp.concatenate([a, b[:1]]), params, rest)
    found = jax.jit(jax.vmap(pose_body, in_axes=(None, 0)))(bundled_body, params)
    arguments = oracle_arguments(params)
    vertices = jax.jit(lambda a: oracle.forward_vertices(**a))(arguments)
    joints = jax.jit(lambda a: oracle.forward_skeleton(**a)[..., :3, 3])(arguments)
    np.testing.assert_allclose(found.vertices, vertices, atol=TOLERANCE["body_m"])
    np.testing.assert_allclose(found.joints, joints, atol=TOLERANCE["body_m"])
    np.testing.assert_allclose(found.vertices[-1], bundled_body.template, atol=TOLERANCE["float32"])


def test_names_and_order_of_joints_agree(bundled_body, oracle):
    stored = {name: k for k, name in enumerate(bundled_body.tree.names)}
    assert stored["left_index1"] == 25
    with np.load(bundled_body.source.path, allow_pickle=False) as file:
        assert file["kintree_table"].shape == (2, 55)
    assert oracle.joint_names == list(bundled_body.tree.names)


def test_gradients_agree_with_differences(bundled_body):
    """In float64, for every kind of parameter, along random directions, at zero and posed."""
    names = ("pose", "betas", "expression", "transl")
    with jax.enable_x64(True):
        body = load_body(bundled_body.source.path, num_betas=10, num_expression=10)
        rng = np.random.default_rng(2)
        probe = jnp.asarray(rng.normal(size=(body.num_vertices, 3)) / body.num_vertices)

        @jax.jit
        def loss(body, probe, params):  # arrays as arguments: constants would be folded for long
            posed = pose_body(body, params)
            return jnp.sum(probe * posed.vertices) + jnp.sum(posed.joints**2)

        slope_of = jax.jit(jax.grad(loss, argnums=2))
        for spread in (0.0, 0.5):
            params = jax.tree.map(lambda x, s=spread: s * x, random_params(body, 1, 1)[0])
            gradient = slope_of(body, probe, params)
            for name in names:
                slope = np.asarray(getattr(gradient, name))
                assert np.isfinite(slope).all()
                direction, step = rng.normal(size=slope.shape), 1e-5
                ends = []
                for sign in (1, -1):
                    leaves = {n: getattr(params, n) for n in names}
                    leaves[name] = leaves[name] + sign * step * direction
                    ends.append(float(loss(body, probe, BodyParams(**leaves, tree=params.tree))))
                difference = (ends[0] - ends[1]) / (2 * step)
                np.testing.assert_allclose(
                    np.sum(slope * direction), difference, rtol=1e-6, atol=1e-8, err_msg=name
                )
