"""Rodrigues' formula and its inverse against SciPy, at zero, at pi and between."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE, central_difference
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from xavatar_jax.kinematics import axis_angle_to_matrix, matrix_to_axis_angle

ANGLES = (0.0, 1e-12, 1e-8, 1e-5, 9.9e-3, 1.01e-2, 0.3, 1.5, 3.0, np.pi - 1e-3, np.pi - 1e-9)

DERIVATIVES = {
    "fwd": jax.jit(jax.jacfwd(axis_angle_to_matrix)),
    "rev": jax.jit(jax.jacrev(axis_angle_to_matrix)),
}


def rotations_of(angle, rng, count=16):
    axis = rng.normal(size=(count, 3))
    axis[:3] = np.eye(3)
    return angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [*ANGLES, np.pi, 4.0, 2 * np.pi, 20.0])
def test_matrices_agree_with_scipy(x64, rng, angle):
    vectors = rotations_of(angle, rng)
    found = axis_angle_to_matrix(jnp.asarray(vectors))
    expected = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float64"])


@pytest.mark.parametrize("angle", ANGLES)
def test_matrices_in_single_precision(rng, angle):
    vectors = rotations_of(angle, rng).astype(np.float32)
    found = axis_angle_to_matrix(jnp.asarray(vectors))
    assert found.dtype == jnp.float32
    expected = Rotation.from_rotvec(vectors.astype(np.float64)).as_matrix()
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float32"])


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float64, (4, 3), elements=st.floats(-6, 6)))
def test_any_vector_gives_a_rotation(vectors):
    with jax.enable_x64(True):
        m = np.asarray(axis_angle_to_matrix(jnp.asarray(vectors)))
    np.testing.assert_allclose(m @ m.swapaxes(1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(m), 1.0, atol=1e-12)
    np.testing.assert_allclose(m, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 5e-3, 1.5e-2, 1.0, 3.1])
@pytest.mark.parametrize("mode", DERIVATIVES.values(), ids=DERIVATIVES)
def test_derivatives_agree_with_differences(x64, rng, angle, mode):
    vector = rotations_of(angle, rng)[5]
    found = mode(jnp.asarray(vector))
    expected = central_difference(lambda v: Rotation.from_rotvec(v).as_matrix(), vector)
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["difference"])


@pytest.mark.parametrize("dtype", [np.float32])
def test_no_nan_at_zero(x64, dtype):
    """At zero the derivative is the cross product's matrix, and the second one is finite too."""
    zero = jnp.zeros(3, dtype)
    first = DERIVATIVES["rev"](zero)
    expected = np.zeros((3, 3, 3))
    for i, j, k, sign in ((0, 1, 2, -1), (1, 2, 0, -1), (2, 0, 1, -1)):
        expected[i, j, k], expected[j, i, k] = sign, -sign
    np.testing.assert_array_equal(first, expected)
    second = jax.jit(jax.jacfwd(jax.jacrev(axis_angle_to_matrix)))(zero)
    assert np.isfinite(second).all()
    # d2R/dx2 at zero is diag(0, -1, -1).
    np.testing.assert_allclose(second[:, :, 0, 0], np.diag([0.0, -1.0, -1.0]), atol=1e-7)


@pytest.mark.parametrize("angle", [*ANGLES, np.pi])
def test_vectors_agree_with_scipy(x64, rng, angle):
    matrices = Rotation.from_rotvec(rotations_of(angle, rng)).as_matrix()
    found = np.asarray(matrix_to_axis_angle(jnp.asarray(matrices)))
    expected = Rotation.from_matrix(matrices).as_rotvec()
    if angle > np.pi - 1e-6:  # both signs of the axis are the same rotation
        flip = np.sign((found * expected).sum(1, keepdims=True))
        expected = expected * flip
    np.testing.assert_allclose(found, expected, atol=1e-7 if angle > 3 else 1e-11)
    assert (np.linalg.norm(found, axis=1) <= np.pi + 1e-12).all()


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float64, 3, elements=st.floats(-1.8, 1.8)))
def test_round_trip(vector):
    with jax.enable_x64(True):
        back = matrix_to_axis_angle(axis_angle_to_matrix(jnp.asarray(vector)))
        again = axis_angle_to_matrix(back)
        matrix = axis_angle_to_matrix(jnp.asarray(vector))
    np.testing.assert_allclose(again, matrix, atol=1e-12)
    if np.linalg.norm(vector) < np.pi - 1e-3:
        np.testing.assert_allclose(back, vector, atol=1e-10)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 0.5, 2.5, 3.1])
def test_single_precision_round_trip(rng, angle):
    vectors = rotations_of(angle, rng).astype(np.float32)
    back = matrix_to_axis_angle(axis_angle_to_matrix(jnp.asarray(vectors)))
    # Near a half turn the entries say little about the angle: the square root of a rounding.
    np.testing.assert_allclose(back, vectors, atol=1e-4 if angle > 3 else 3e-6)


def test_gradient_of_the_inverse_at_the_identity(x64):
    through = jax.jit(jax.jacrev(lambda v: matrix_to_axis_angle(axis_angle_to_matrix(v))))
    through = through(jnp.zeros(3))
    np.testing.assert_allclose(through, np.eye(3), atol=1e-12)


def test_batches_jit_and_vmap(rng):
    vectors = jnp.asarray(rng.normal(size=(2, 4, 3)), jnp.float32)
    plain = axis_angle_to_matrix(vectors)
    assert plain.shape == (2, 4, 3, 3)
    np.testing.assert_allclose(jax.jit(axis_angle_to_matrix)(vectors), plain, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(jax.vmap(axis_angle_to_matrix))(vectors), plain, atol=1e-6)
    assert matrix_to_axis_angle(plain).shape == (2, 4, 3)
