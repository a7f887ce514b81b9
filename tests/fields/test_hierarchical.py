"""The hierarchical softmax against a recursive one, written from its definition in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PARENTS, TOLERANCE, TREES
from hypothesis import given, settings
from hypothesis import strategies as st

from xavatar_jax.fields import (
    SOFT_BLEND,
    hierarchical_logits,
    hierarchical_softmax,
    num_logits,
)
from xavatar_jax.kinematics import KinematicTree

# Gate logits of branching joints, as the released networks order them.
GATES = {
    "smplx": {0: 0, 9: 55, 15: 56, 20: 57, 21: 58},
    "smplh": {0: 0, 9: 52, 20: 53, 21: 54},
    "smpl": {0: 0, 9: 24},
    "mano": {0: 0},
}


def logistic(z):
    return 0.5 * (1 + np.tanh(0.5 * z))


def reference(parents, gates, logits):
    """Mass walks down from the root, joint by joint."""
    weights = np.zeros(len(parents))

    def walk(joint, mass):
        children = [k for k, parent in enumerate(parents) if parent == joint]
        if not children:
            weights[joint] = mass
            return
        down = logistic(logits[gates.get(joint, children[0])])
        weights[joint] = mass * (1 - down)
        share = np.exp(logits[children] - logits[children].max())
        share = share / share.sum()
        for child, part in zip(children, share, strict=True):
            walk(child, mass * down * part)

    walk(0, 1.0)
    return weights


def gates_of(parents):
    """The same order for any tree: the root's gate first, later branches after the joints."""
    gates, extra = {0: 0}, len(parents)
    for joint in range(1, len(parents)):
        if sum(parent == joint for parent in parents) > 1:
            gates[joint] = extra
            extra += 1
    return gates, extra


@st.composite
def trees(draw):
    count = draw(st.integers(1, 12))
    parents = [-1] + [draw(st.integers(0, j - 1)) for j in range(1, count)]
    return tuple(parents)


def test_number_of_logits():
    assert SOFT_BLEND == 20
    assert {kind: num_logits(tree) for kind, tree in TREES.items()} == {
        "smplx": 59, "smplh": 55, "smpl": 25, "mano": 16,
    }  # fmt: skip


@pytest.mark.parametrize("kind", PARENTS)
@pytest.mark.parametrize("size", [0.0, 1.0, 30.0])
def test_weights_of_the_family(kind, size, rng):
    assert gates_of(PARENTS[kind])[0] == GATES[kind]
    logits = size * rng.normal(size=(40, num_logits(TREES[kind])))
    expected = np.stack([reference(PARENTS[kind], GATES[kind], row) for row in logits])
    with jax.enable_x64(True):
        found = jax.jit(hierarchical_softmax, static_argnums=0)(TREES[kind], jnp.asarray(logits))
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float64"])
    single = jax.jit(hierarchical_softmax, static_argnums=0)(
        TREES[kind], jnp.asarray(logits, jnp.float32)
    )
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected, atol=TOLERANCE["float32_deep"])


@pytest.mark.parametrize("kind", PARENTS)
def test_weights_sum_to_one_in_single_precision(kind, rng):
    sizes = np.repeat([0.1, 1.0, 10.0, 100.0], 250)[:, None]
    logits = (sizes * rng.normal(size=(1000, num_logits(TREES[kind])))).astype(np.float32)
    weights = np.asarray(
        jax.jit(hierarchical_softmax, static_argnums=0)(TREES[kind], jnp.asarray(logits)),
        np.float64,
    )
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=TOLERANCE["sum_to_one"])


def test_derivatives_of_weights_near_one_keep_their_digits_in_single_precision(rng):
    """Where one bone has all but a hundred thousandth, its weight's derivative is of that size."""
    tree = TREES["smplx"]
    logits = rng.normal(size=(50, num_logits(tree)))
    to_left_thumb = [0, 3, 6, 55, 9, 13, 16, 18, 20, 57, 37]
    logits[:, to_left_thumb] += 14
    logits[:, 38] -= 14  # which keeps what arrives
    way = rng.normal(size=logits.shape)

    @jax.jit
    def slope(logits, way):
        return jax.jvp(lambda v: hierarchical_softmax(tree, v), (logits,), (way,))[1]

    found = np.asarray(slope(jnp.asarray(logits, jnp.float32), jnp.asarray(way, jnp.float32)))
    with jax.enable_x64(True):
        exact = np.asarray(slope(jnp.asarray(logits), jnp.asarray(way)))
    gap = np.linalg.norm(found - exact, axis=1) / np.linalg.norm(exact, axis=1)
    assert gap.max() < 1e-5


@settings(max_examples=8, deadline=None)
@given(trees(), st.integers(0, 2**31))
def test_weights_of_any_tree(parents, seed):
    tree = KinematicTree(tuple(f"j{k}" for k in range(len(parents))), parents)
    gates, count = gates_of(parents)
    assert num_logits(tree) == count
    logits = 3 * np.random.default_rng(seed).normal(size=(4, count))
    expected = np.stack([reference(parents, gates, row) for row in logits])
    with jax.enable_x64(True):
        found = jax.jit(hierarchical_softmax, static_argnums=0)(tree, jnp.asarray(logits))
        found = np.asarray(found)
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float64"])
    # And back: logits of any weights that are not too small.
    weights = np.random.default_rng(seed).dirichlet(np.ones(len(parents)), 4)
    with jax.enable_x64(True):
        back = jax.jit(hierarchical_softmax, static_argnums=0)(
            tree, jnp.asarray(hierarchical_logits(tree, weights, floor=1e-9))
        )
        back = np.asarray(back)
    np.testing.assert_allclose(back, weights, atol=1e-8)


@pytest.mark.parametrize("kind", PARENTS)
def test_logits_invert_the_softmax(kind, rng):
    tree = TREES[kind]
    joints = tree.num_joints
    weights = np.concatenate([rng.dirichlet(np.full(joints, 0.3), 50), np.eye(joints)])
    logits = hierarchical_logits(tree, weights, floor=1e-4)
    assert np.isfinite(logits).all()
    back = np.stack([reference(PARENTS[kind], GATES[kind], row) for row in logits])
    floored = (weights + 1e-4 / joints) / (1 + 1e-4)
    np.testing.assert_allclose(back, floored, atol=1e-10)
    np.testing.assert_allclose(back, weights, atol=1e-4)


def test_gradients_are_finite_for_extreme_logits(rng):
    tree = TREES["smplx"]
    logits = jnp.asarray(200 * rng.normal(size=(20, 59)), jnp.float32)
    slope = jax.jit(jax.grad(lambda s: jnp.sum(hierarchical_softmax(tree, s)[..., 20] ** 2)))
    assert np.isfinite(slope(logits)).all()


def test_wrong_number_of_logits():
    with pytest.raises(ValueError, match="58 logits for a tree of 55 joints, which needs 59"):
        hierarchical_softmax(TREES["smplx"], jnp.zeros(58))
