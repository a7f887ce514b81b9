"""The body's functions on every tree of the family, against a plain NumPy loop."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import COLUMNS, PARENTS, TOLERANCE, all_finite, reference_body, toy_arrays

from xavatar_jax.body import (
    BodyParams,
    bone_transforms,
    canonical_joints,
    canonical_params,
    canonical_pose,
    canonical_vertices,
    load_body,
    pose_body,
    pose_offsets,
    rest_joints,
    rest_vertices,
    with_template,
)
from xavatar_jax.kinematics import axis_angle_to_matrix, skin_points


def random_params(body, rng, batch=(), coefficients=5, bend=0.5):
    return BodyParams.create(
        body,
        pose=bend * rng.normal(size=(*batch, body.num_joints, 3)),
        betas=rng.normal(size=(*batch, coefficients)),
        expression=rng.normal(size=(*batch, min(coefficients, body.num_expression))),
        transl=rng.normal(size=(*batch, 3)),
    )


@pytest.mark.parametrize("kind", PARENTS)
def test_posing_agrees_with_a_loop(family, family_arrays, rng, kind):
    body, arrays = family[kind], family_arrays[kind]
    params = random_params(body, rng)
    found = jax.jit(pose_body)(body, params)
    vertices, joints = reference_body(
        arrays,
        np.asarray(params.betas),
        np.asarray(params.pose),
        np.asarray(params.transl),
        np.asarray(params.expression) if kind == "smplx" else None,
    )
    np.testing.assert_allclose(found.vertices, vertices, atol=TOLERANCE["body_m"])
    np.testing.assert_allclose(found.joints, joints, atol=TOLERANCE["body_m"])


def test_another_tree_works_alike(tmp_path, rng):
    names = ("root", "a", "b", "tail1", "tail2")
    arrays = toy_arrays((-1, 0, 1, 0, 3), columns=5, names=names)
    np.savez(tmp_path / "creature.npz", **arrays)
    body = load_body(tmp_path / "creature.npz")
    assert (body.kind, body.tree.names, body.num_betas, body.num_expression) == (
        "other", names, 5, 0,
    )  # fmt: skip
    params = random_params(body, rng)
    found = jax.jit(pose_body)(body, params)
    vertices, joints = reference_body(
        arrays, np.asarray(params.betas), np.asarray(params.pose), np.asarray(params.transl)
    )
    np.testing.assert_allclose(found.vertices, vertices, atol=TOLERANCE["body_m"])
    np.testing.assert_allclose(found.joints, joints, atol=TOLERANCE["body_m"])
    assert not np.asarray(canonical_pose(body)).any()  # its axes are unknown: the rest pose


def test_vmap_equals_a_loop(family, rng):
    body = family["smplh"]
    params = random_params(body, rng, (4,))
    many = jax.jit(jax.vmap(partial(pose_body, body)))(params)
    one = jax.jit(partial(pose_body, body))
    for k in range(4):
        np.testing.assert_allclose(many.vertices[k], one(params[k]).vertices, atol=2e-6)
        np.testing.assert_allclose(many.joints[k], one(params[k]).joints, atol=2e-6)


def test_no_retrace_on_the_second_call(family, rng):
    traced = eqx.debug.assert_max_traces(max_traces=1)(pose_body)
    run = eqx.filter_jit(traced)
    for _ in range(3):
        run(family["smpl"], random_params(family["smpl"], rng))


def test_nothing_is_nan_at_zero(family):
    body = family["smplx"]
    zero = BodyParams.zeros(body)

    @jax.jit
    @jax.value_and_grad
    def loss(params):
        posed = pose_body(body, params)
        moved = jnp.sum(bone_transforms(body, params)[:, :3] ** 2)
        return jnp.sum(posed.vertices**2) + jnp.sum(posed.joints**2) + moved

    value, gradient = loss(zero)
    assert np.isfinite(value)
    assert all_finite(gradient)
    assert np.abs(gradient.pose).max() > 0
    posed = jax.jit(pose_body)(body, zero)
    np.testing.assert_allclose(posed.vertices, body.template, atol=TOLERANCE["float32"])


def test_derivatives_agree_with_differences(x64, tmp_path, rng):
    """Both modes, at zero and bent. In float64 the body is loaded in float64."""
    arrays = toy_arrays(PARENTS["mano"], num_vertices=20)
    np.savez(tmp_path / "MANO_RIGHT.npz", **arrays)
    body = load_body(tmp_path / "MANO_RIGHT.npz")
    assert body.template.dtype == jnp.float64

    @jax.jit
    def run(params):
        posed, bones = pose_body(body, params), bone_transforms(body, params)
        return jnp.concatenate([x.ravel() for x in (posed.vertices, posed.joints, bones)])

    forward = jax.jit(lambda p, t: jax.jvp(run, (p,), (t,))[1])
    backward = jax.jit(lambda p, c: jax.vjp(run, p)[1](c)[0])
    for bend in (0.0, 0.6):
        params = random_params(body, rng, bend=bend)
        tangent = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), params)
        moved = [
            run(jax.tree.map(lambda x, t, s=s: x + s * t, params, tangent)) for s in (1e-6, -1e-6)
        ]
        difference = (moved[0] - moved[1]) / 2e-6
        np.testing.assert_allclose(forward(params, tangent), difference, atol=1e-7)
        cotangent = jnp.asarray(rng.normal(size=difference.shape))
        pulled = backward(params, cotangent)
        products = jax.tree.map(lambda a, b: jnp.sum(a * b), pulled, tangent)
        total = sum(float(x) for x in jax.tree.leaves(products))
        np.testing.assert_allclose(total, jnp.sum(cotangent * difference), rtol=1e-6)


def test_pieces_of_posing(family, family_arrays, rng):
    body, arrays = family["smplx"], family_arrays["smplx"]
    betas, expression = rng.normal(size=7), rng.normal(size=4)
    rest = arrays["v_template"] + arrays["shapedirs"][..., :7] @ betas
    rest = rest + arrays["shapedirs"][..., 300:304] @ expression
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    found = rest_vertices(body, f32(betas), f32(expression))
    np.testing.assert_allclose(found, rest, atol=TOLERANCE["float32"])
    found = rest_joints(body, f32(betas), f32(expression))
    np.testing.assert_allclose(found, arrays["J_regressor"] @ rest, atol=TOLERANCE["float32"])
    eye = jnp.broadcast_to(jnp.eye(3), (55, 3, 3))
    assert not np.asarray(pose_offsets(body, eye)).any()
    # The root's rotation turns the body and corrects nothing.
    turned = eye.at[0].set(axis_angle_to_matrix(jnp.array([0.0, 1.0, 0.0])))
    assert not np.asarray(pose_offsets(body, turned)).any()


def test_canonical_pose_of_the_family(family):
    pose = np.asarray(canonical_pose(family["smplx"]))
    expected = np.zeros((55, 3))
    expected[1, 2], expected[2, 2], expected[22, 0] = np.pi / 6, -np.pi / 6, 0.2
    np.testing.assert_allclose(pose, expected, atol=1e-7)
    np.testing.assert_allclose(canonical_pose(family["smpl"])[:22], expected[:22], atol=1e-7)
    assert not np.asarray(canonical_pose(family["mano"])).any()


@pytest.mark.parametrize("kind", ["smplx", "mano"])
def test_bones_map_the_canonical_body_to_the_posed_one(family, rng, kind):
    """Joints, which are rigid, land where posing puts them; so do one-bone vertices."""
    body = family[kind]
    params = random_params(body, rng)
    params = eqx.tree_at(lambda p: p.expression, params, jnp.zeros_like(params.expression))
    transforms = jax.jit(bone_transforms)(body, params)
    rest = jax.jit(canonical_joints)(body, params.betas)
    moved = jnp.einsum("jab,jb->ja", transforms[:, :3, :3], rest) + transforms[:, :3, 3]
    posed = jax.jit(pose_body)(body, params)
    np.testing.assert_allclose(moved, posed.joints, atol=TOLERANCE["body_m"])
    canonical = jax.jit(pose_body)(body, canonical_params(body, params.betas))
    np.testing.assert_allclose(canonical.joints, rest, atol=TOLERANCE["body_m"])
    found = jax.jit(canonical_vertices)(body, params.betas)
    np.testing.assert_allclose(found, canonical.vertices, atol=TOLERANCE["float32"])


def test_bones_of_the_canonical_pose_are_the_identity(family, rng):
    body = family["smplx"]
    params = canonical_params(body, jnp.asarray(rng.normal(size=3), jnp.float32))
    expected = np.broadcast_to(np.eye(4), (55, 4, 4))
    np.testing.assert_allclose(
        jax.jit(bone_transforms)(body, params), expected, atol=TOLERANCE["float32_deep"]
    )


def test_skinning_the_canonical_body_poses_it_without_correctives(bundled_body, rng):
    """With no pose correctives, bones and weights carry canonical vertices to the posed body."""
    body = eqx.tree_at(lambda b: b.pose_dirs, bundled_body, replace_fn=jnp.zeros_like)
    params = random_params(body, rng, bend=0.0)
    # One joint at a time is exact for vertices that one bone owns.
    pose = params.pose.at[18].set(jnp.array([0.0, -0.8, 0.0]))
    params = eqx.tree_at(lambda p: (p.pose, p.expression), params, (pose, jnp.zeros(5)))
    canonical = jax.jit(canonical_vertices)(body, params.betas)
    skinned = skin_points(canonical, body.weights, jax.jit(bone_transforms)(body, params))
    posed = jax.jit(pose_body)(body, params).vertices
    owned = np.asarray(body.weights.max(1)) > 0.9999
    assert owned.sum() > 1000
    np.testing.assert_allclose(skinned[owned], posed[owned], atol=1e-4)


def test_a_subjects_template(family, family_arrays, rng):
    body, arrays = family["smplx"], family_arrays["smplx"]
    template = arrays["v_template"] + 0.01 * rng.normal(size=(90, 3))
    own = with_template(body, template)
    np.testing.assert_allclose(own.template, template, atol=1e-7)
    joints = arrays["J_regressor"] @ template
    np.testing.assert_allclose(own.joint_template, joints, atol=TOLERANCE["float32"])
    changed = {**arrays, "v_template": template}
    params = random_params(body, rng)
    vertices, _ = reference_body(
        changed, *(np.asarray(x) for x in (params.betas, params.pose, params.transl)),
        expression=np.asarray(params.expression),
    )  # fmt: skip
    np.testing.assert_allclose(
        jax.jit(pose_body)(own, params).vertices, vertices, atol=TOLERANCE["body_m"]
    )
    with pytest.raises(ValueError, match=r"\(89, 3\), expected \(90, 3\)"):
        with_template(body, template[1:])


def test_parameters_that_do_not_fit(family, rng):
    body = family["smplx"]
    with pytest.raises(ValueError, match=r"\(24, 3\), but the body \(smplx.*\(55, 3\)"):
        pose_body(body, BodyParams.zeros(family["smpl"]))
    with pytest.raises(ValueError, match=r"vmap for a batch"):
        pose_body(body, BodyParams.zeros(body, (2,)))
    params = random_params(body, rng)
    with pytest.raises(ValueError, match=r"betas has shape \(301,\), expected .* n <= 300"):
        bone_transforms(body, eqx.tree_at(lambda p: p.betas, params, jnp.zeros(301)))


def test_counts(family):
    for kind, body in family.items():
        assert body.num_vertices == 90
        assert body.num_joints == len(PARENTS[kind])
        assert body.num_betas == (300 if kind == "smplx" else COLUMNS[kind])
        assert body.num_expression == (100 if kind == "smplx" else 0)
        assert body.kind == kind
