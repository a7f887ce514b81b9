"""Closed-form inverses against NumPy, skinning against its definition, and there and back."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE, central_difference
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from xavatar_jax.kinematics import (
    blend_transforms,
    determinant_3x3,
    inverse_3x3,
    inverse_rigid,
    skin_points,
    solve_3x3,
    transform_point,
    unskin_points,
)


def rigid(rng, count, scale=1.0):
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = scale * Rotation.random(count, random_state=rng).as_matrix()
    out[:, :3, 3] = rng.normal(size=(count, 3))
    return out


@settings(max_examples=80, deadline=None)
@given(hnp.arrays(np.float64, (3, 3), elements=st.floats(-3, 3)))
def test_inverse_3x3_agrees_with_numpy(matrix):
    if np.linalg.cond(matrix) > 1e4 or np.abs(matrix).max() < 1e-90:
        return  # the determinant may underflow
    with jax.enable_x64(True):
        found = inverse_3x3(jnp.asarray(matrix))
    expected = np.linalg.inv(matrix)
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_solutions_and_determinants_agree_with_numpy(x64, rng):
    matrices, values = rng.normal(size=(4, 5, 3, 3)), rng.normal(size=(4, 5, 3))
    found = solve_3x3(jnp.asarray(matrices), jnp.asarray(values))
    np.testing.assert_allclose(found, np.linalg.solve(matrices, values[..., None])[..., 0])
    np.testing.assert_allclose(determinant_3x3(jnp.asarray(matrices)), np.linalg.det(matrices))
    assert not np.isfinite(solve_3x3(jnp.ones((3, 3)), jnp.ones(3))).any()


def test_inverse_3x3_of_a_batch_and_of_a_singular_matrix(rng):
    batch = rng.normal(size=(2, 5, 3, 3)) + 3 * np.eye(3)
    found = inverse_3x3(jnp.asarray(batch, jnp.float32))
    np.testing.assert_allclose(found, np.linalg.inv(batch), atol=TOLERANCE["float32_deep"])
    assert not np.isfinite(inverse_3x3(jnp.ones((3, 3)))).any()


@pytest.mark.parametrize("scale", [1.0, 0.3, 7.0])
def test_inverse_rigid_agrees_with_numpy(x64, rng, scale):
    transforms = rigid(rng, 12, scale).reshape(3, 4, 4, 4)
    found = inverse_rigid(jnp.asarray(transforms))
    np.testing.assert_allclose(found, np.linalg.inv(transforms), atol=1e-11)


def test_skinning_is_the_weighted_sum_of_moved_points(x64, rng):
    transforms, points = rigid(rng, 6), rng.normal(size=(20, 3))
    weights = rng.dirichlet(np.ones(6), 20)
    expected = np.zeros((20, 3))
    for p in range(20):
        for j in range(6):
            moved = transforms[j, :3, :3] @ points[p] + transforms[j, :3, 3]
            expected[p] += weights[p, j] * moved
    found = skin_points(*map(jnp.asarray, (points, weights, transforms)))
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float64"])
    one = skin_points(*map(jnp.asarray, (points[3], weights[3], transforms)))
    np.testing.assert_allclose(one, expected[3], atol=TOLERANCE["float64"])
    run = jax.jit(jax.vmap(skin_points, in_axes=(0, 0, None)))
    found = run(*map(jnp.asarray, (points, weights, transforms)))
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float64"])


def test_one_hot_weights_move_rigidly(x64, rng):
    transforms, point = rigid(rng, 4), rng.normal(size=3)
    blended = blend_transforms(jnp.eye(4), jnp.asarray(transforms))
    np.testing.assert_array_equal(blended, transforms[:, :3])
    moved = transform_point(blended, jnp.broadcast_to(jnp.asarray(point), (4, 3)))
    np.testing.assert_allclose(moved, (transforms @ np.append(point, 1))[:, :3], atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_there_and_back(x64, rng, scale):
    # Rotations within half a turn of one another: their blend is far from singular.
    transforms = rigid(rng, 5, scale)
    turns = Rotation.from_rotvec(0.5 * rng.normal(size=(5, 3))).as_matrix()
    transforms[:, :3, :3] = scale * turns
    points, weights = rng.normal(size=(30, 3)), rng.dirichlet(np.ones(5), 30)
    posed = skin_points(*map(jnp.asarray, (points, weights, transforms)))
    back = unskin_points(posed, jnp.asarray(weights), jnp.asarray(transforms))
    np.testing.assert_allclose(back, points, atol=1e-11)


def test_gradients_of_skinning_and_its_inverse(x64, rng):
    transforms = jnp.asarray(rigid(rng, 3))
    weights, point = jnp.asarray([0.7, 0.2, 0.1]), jnp.asarray(rng.normal(size=3))
    for fn in (skin_points, unskin_points):
        on_arrays = lambda *args, fn=fn: fn(*map(jnp.asarray, args))  # noqa: E731
        check_grads(on_arrays, (point, weights, transforms), order=1, modes=("fwd", "rev"))
    found = jax.jacfwd(inverse_3x3)(transforms[0, :3, :3] + jnp.eye(3))
    expected = central_difference(np.linalg.inv, np.asarray(transforms[0, :3, :3]) + np.eye(3))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
