"""Roots and derivatives over random trees and poses: differences, float64, the plain path."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ArmField, arm_skin, arm_transforms, central_difference, two_bone_arm
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from xavatar_jax.correspondence import (
    MIN_DETERMINANT,
    Broyden,
    StartTable,
    find_correspondences,
    implicit_root,
    pair_rows,
    search_field,
    start_table,
)
from xavatar_jax.fields import AbstractSkinningField, skin_with_jacobian
from xavatar_jax.kinematics import KinematicTree

BONES = 4


class Blobs(AbstractSkinningField):
    """Weights by distance to each bone's centre: smooth, analytic, for any tree."""

    centre: jax.Array
    sharpness: jax.Array

    def __call__(self, x):
        return jax.nn.softmax(-self.sharpness * jnp.sum((x - self.centre) ** 2, axis=-1))

    def covers(self, x):
        return jnp.all(jnp.isfinite(x))


def random_body(seed, degrees):
    """A random tree of four joints 0.3 m apart, its field and a random pose, in plain NumPy."""
    rng = np.random.default_rng(seed)
    parents = [-1, *(int(rng.integers(0, k)) for k in range(1, BONES))]
    joints = np.zeros((BONES, 3))
    for k in range(1, BONES):
        step = rng.normal(size=3)
        joints[k] = joints[parents[k]] + 0.3 * step / np.linalg.norm(step)
    transforms = np.zeros((BONES, 4, 4))
    for k in range(BONES):
        turn = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=3)).as_matrix()
        local = np.eye(4)
        local[:3, :3] = turn
        local[:3, 3] = joints[k] - turn @ joints[k]
        transforms[k] = local if k == 0 else transforms[parents[k]] @ local
    points = joints[rng.integers(0, BONES, 20)] + 0.05 * rng.normal(size=(20, 3))
    return joints, transforms, points


def blob_skin(x, joints, transforms, sharpness):
    """The map of `Blobs` in plain NumPy."""
    logits = -sharpness * ((x[:, None] - joints) ** 2).sum(-1)
    weights = np.exp(logits - logits.max(1, keepdims=True))
    weights /= weights.sum(1, keepdims=True)
    moved = np.einsum("jab,nb->nja", transforms[:, :3, :3], x) + transforms[:, :3, 3]
    return (weights[..., None] * moved).sum(1)


EVERY = StartTable(
    jnp.arange(BONES)[None], jnp.ones((1, BONES), bool), jnp.zeros(BONES, jnp.int32)
)  # fmt: skip


@eqx.filter_jit
def both_paths(field, points, transforms):
    plain = jax.vmap(
        lambda x: find_correspondences(x, field, transforms, init_bones=tuple(range(BONES)))
    )(points)
    return plain, search_field(field, points, jnp.zeros(len(points), int), transforms, EVERY)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), degrees=st.floats(0, 40))
def test_roots_of_random_trees_and_poses(seed, degrees):
    """Every root is one, by NumPy; the fast search finds what the plain one does."""
    joints, transforms, points = random_body(seed, degrees)
    x_d = blob_skin(points, joints, transforms, 40.0)
    field = Blobs(jnp.asarray(joints, jnp.float32), jnp.asarray(40.0, jnp.float32))
    plain, fast = both_paths(
        field, jnp.asarray(x_d, jnp.float32), jnp.asarray(transforms, jnp.float32)
    )
    for x_c, good in ((plain.x_c, plain.found), (fast.x_c, fast.valid)):
        good, x_c = np.asarray(good), np.asarray(x_c, np.float64)
        again = blob_skin(x_c[good], joints, transforms, 40.0)
        target = np.repeat(x_d[:, None], good.shape[1], 1)[good]
        assert np.linalg.norm(again - target, axis=-1).max(initial=0) < 1.2e-5
    # A root that the plain path found and that is no fold is among those of the fast one.
    some, missed = 0, 0
    for p in range(len(x_d)):
        fast_roots = np.asarray(fast.x_c[p])[np.asarray(fast.valid[p])]
        for root in np.asarray(plain.x_c[p])[np.asarray(plain.found[p])]:
            some += 1
            gap = np.linalg.norm(fast_roots - root, axis=-1).min(initial=np.inf)
            missed += gap > 1e-3
    assert some > 20
    assert missed <= 0.03 * some


@jax.jit
def polished(root, joints, transforms, x_d):
    field = Blobs(joints, jnp.asarray(40.0, joints.dtype))
    return jax.vmap(lambda x, p: implicit_root(x, p, field, transforms)[0])(root, x_d)


@jax.jit
def polish_often(root, joints, transforms, x_d):
    for _ in range(8):
        root = polished(root, joints, transforms, x_d)
    return root


@jax.jit
def slopes(root, joints, transforms, x_d):
    given = (joints, transforms, x_d)
    fn = lambda *args: polished(root, *args).sum(0)  # noqa: E731
    return jax.jacfwd(fn, (0, 1, 2))(*given), jax.jacrev(fn, (0, 1, 2))(*given)


@jax.jit
def determinants(root, joints, transforms):
    field = Blobs(joints, jnp.asarray(40.0, joints.dtype))
    return jax.vmap(lambda x: jnp.linalg.det(skin_with_jacobian(field, x, transforms)[1]))(root)


@settings(max_examples=6, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000))
def test_gradients_of_random_trees_and_poses(seed):
    """By field, transforms and points: forward, reverse and differences; float32 near float64."""
    joints, transforms, points = random_body(seed, 20.0)
    x_d = blob_skin(points, joints, transforms, 40.0)
    regular = np.abs(np.asarray(determinants(points, joints, transforms))) >= 0.2
    points, x_d = points[regular][:4], x_d[regular][:4]
    points, x_d = np.resize(points, (4, 3)), np.resize(x_d, (4, 3))  # one shape, one program
    with jax.enable_x64(True):
        args = (jnp.asarray(joints), jnp.asarray(transforms), jnp.asarray(x_d))
        forward, reverse = slopes(jnp.asarray(points), *args)
        for k in range(3):

            def root(value, k=k):
                moved = [*args[:k], jnp.asarray(value), *args[k + 1 :]]
                return polish_often(jnp.asarray(points), *moved).sum(0)

            expected = central_difference(root, np.asarray(args[k]), step=1e-5)
            size = np.abs(expected).max()
            np.testing.assert_allclose(np.asarray(forward[k]) / size, expected / size, atol=1e-6)
            np.testing.assert_allclose(reverse[k], forward[k], atol=1e-9 * max(size, 1))
        exact = [np.asarray(v) for v in forward]
    left = points + 1e-5 / np.sqrt(3)  # as far from the root as a search may end
    single = [jnp.asarray(v, jnp.float32) for v in (left, joints, transforms, x_d)]
    for mode in slopes(*single):
        for found, wanted in zip(mode, exact, strict=True):
            assert np.asarray(found).dtype == np.float32
            assert np.linalg.norm(np.asarray(found) - wanted) < 1e-3 * np.linalg.norm(wanted)


def test_the_fast_path_has_the_gradients_of_the_plain_one(x64):
    """Sum over all roots of each point, by field, transforms and points."""
    field, transforms = two_bone_arm(0.6)
    x_c = np.random.default_rng(3).uniform(-0.2, 0.2, (12, 3)) * [1, 0.2, 0.2]
    points = jnp.asarray(arm_skin(x_c, 0.6))
    one_start = StartTable(
        jnp.array([[0]]), jnp.array([[True]]), jnp.array([0, 0], jnp.int32)
    )  # fmt: skip
    solver = Broyden(atol=1e-12, divergence=1.0)

    def fast(args):
        sharpness, transforms, points = args
        field = ArmField(sharpness)
        roots = search_field(
            jax.lax.stop_gradient(field), jax.lax.stop_gradient(points),
            jnp.zeros(len(points), int), jax.lax.stop_gradient(transforms), one_start,
            solver=solver, keep=1,
        )  # fmt: skip
        x = jax.vmap(lambda x, p: implicit_root(x, p, field, transforms)[0])(
            roots.x_c[:, 0], points
        )
        return jnp.sum(jnp.where(roots.valid, x, 0.0) ** 2 + x)

    def plain(args):
        sharpness, transforms, points = args
        out = jax.vmap(
            lambda p: find_correspondences(
                p, ArmField(sharpness), transforms, init_bones=(0,), solver=solver
            )
        )(points)
        x = out.x_c[:, 0]
        return jnp.sum(jnp.where(out.found, x, 0.0) ** 2 + x)

    args = (field.sharpness, transforms, points)
    (value, found), (wanted, expected) = (
        jax.jit(jax.value_and_grad(fn))(args) for fn in (fast, plain)
    )
    np.testing.assert_allclose(value, wanted, rtol=1e-10)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)


def test_near_a_fold_nothing_is_nan(x64):
    """Through a half turn the determinant passes the limit: derivatives, or none, never NaN."""
    x = jnp.asarray(np.linspace([-0.05, 0, 0], [0.05, 0, 0], 41))
    limits = []
    for bend in (2.0, 2.6, 3.0, np.pi):
        field, transforms = two_bone_arm(bend)

        def total(points, field=field, transforms=transforms):
            out, _, regular = jax.vmap(lambda a, p: implicit_root(a, p, field, transforms))(
                x, points
            )
            return jnp.sum(out**2), regular

        slope, regular = jax.grad(total, has_aux=True)(jnp.asarray(arm_skin(np.array(x), bend)))
        assert np.isfinite(slope).all()
        det = jax.vmap(lambda a, f=field, t=transforms: jnp.linalg.det(
            skin_with_jacobian(f, a, t)[1]))(x)  # fmt: skip
        np.testing.assert_array_equal(regular, np.abs(det) >= MIN_DETERMINANT)
        assert not np.asarray(slope)[~np.asarray(regular)].any()
        limits.append(int(np.asarray(regular).sum()))
    assert limits[0] > limits[-1]


# Self-contact with known answers: a chain of two links folded back on itself.


class Chain(ArmField):
    """Sharp weights: a few centimetres from the elbow a link moves as one bone."""

    def __call__(self, x_c):
        second = jax.nn.sigmoid(200.0 * x_c[0])
        return jnp.stack([1 - second, second])


@pytest.mark.parametrize("bend", [2.4, 2.8, np.pi])
def test_where_a_limb_lies_on_itself_both_places_are_found(rng, bend):
    """The second root is the inverse of the second bone: weights there are one to seven digits."""
    x = rng.uniform([-0.4, -0.02, -0.02], [-0.2, 0.02, 0.02], (60, 3))
    turned = Rotation.from_rotvec([0, 0, bend]).inv().apply(x)
    transforms = arm_transforms(bend)
    contact = turned[:, 0] > 0.1
    assert contact.sum() > 30
    points = jnp.asarray(x[contact], jnp.float32)
    tree = KinematicTree(("root", "second"), (-1, 0))
    one_each = start_table(
        tree, groups={"body": (0,), "left_hand": (1,), "full": (0, 1)}, pairs=True
    )
    full = start_table(tree, "full", groups={"full": (0, 1)})
    labels = jnp.zeros(len(points), int)
    pairs = jnp.full(len(points), int(pair_rows(5)[0, 2]))
    chain = Chain(jnp.asarray(20.0))
    for rows, table in ((labels, full), (pairs, one_each)):
        found = search_field(chain, points, rows, transforms, table)
        np.testing.assert_array_equal(np.asarray(found.valid).sum(1), 2)
        roots = np.asarray(found.x_c)
        for truth in (x[contact], turned[contact]):
            gap = np.linalg.norm(roots - truth[:, None], axis=-1)
            assert np.where(np.asarray(found.valid), gap, np.inf).min(1).max() < 1e-4
    alone = search_field(chain, points, labels, transforms, one_each)
    np.testing.assert_array_equal(np.asarray(alone.valid).sum(1), 1)
