"""Loss terms with values worked out by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE

from xavatar_jax.losses import binary_cross_entropy, soft_occupancy, squared_error


def test_cross_entropy_by_hand(x64):
    cases = [
        (0.0, 0.0, np.log(2)),
        (0.0, 1.0, np.log(2)),
        (0.0, 0.3, np.log(2)),
        (np.log(3), 1.0, np.log(4 / 3)),  # sigma = 3/4
        (np.log(3), 0.0, np.log(4)),
        (-np.log(3), 0.0, np.log(4 / 3)),
        (np.log(3), 0.5, 0.5 * (np.log(4 / 3) + np.log(4))),
        (800.0, 0.0, 800.0),  # no overflow
        (-800.0, 1.0, 800.0),
        (800.0, 1.0, 0.0),
    ]
    logit, target, expected = (jnp.asarray(column) for column in zip(*cases, strict=True))
    found = binary_cross_entropy(logit, target)
    assert found.shape == (len(cases),)  # elementwise: no hidden mean
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float64"])
    np.testing.assert_allclose(jax.jit(binary_cross_entropy)(logit, target), expected, atol=1e-12)


def test_cross_entropy_slope_is_probability_less_target(x64):
    logit = jnp.array([-700.0, -2.0, 0.0, 0.5, 30.0])
    target = jnp.array([1.0, 0.2, 0.5, 0.0, 1.0])
    slope = jax.vmap(jax.grad(binary_cross_entropy))(logit, target)
    expected = 0.5 * (1 + np.tanh(0.5 * np.asarray(logit))) - np.asarray(target)
    np.testing.assert_allclose(slope, expected, atol=1e-12)
    assert np.isfinite(slope).all()


def test_squared_error_by_hand():
    found = squared_error(jnp.array([1.0, -2.0, 0.5]), jnp.array([3.0, -2.0, 0.0]))
    np.testing.assert_array_equal(found, [4.0, 0.0, 0.25])


@pytest.mark.parametrize("loss", [binary_cross_entropy, squared_error])
@pytest.mark.parametrize(("a", "b"), [((3,), (3, 1)), ((3,), ()), ((2, 3), (3, 2))])
def test_shapes_must_agree(loss, a, b):
    with pytest.raises(ValueError, match="shapes differ"):
        loss(jnp.zeros(a), jnp.zeros(b))


def test_soft_occupancy_by_hand(x64):
    distance = jnp.array([-0.02, -0.01, 0.0, 0.01, 0.02])
    expected = 1 / (1 + np.exp(-np.asarray(distance) / 0.01))
    np.testing.assert_allclose(soft_occupancy(distance, 0.01), expected, atol=1e-14)
    np.testing.assert_array_equal(soft_occupancy(distance, 0.0), [0, 0, 0, 1, 1])


def test_soft_occupancy_tends_to_a_step():
    distance = jnp.array([-1.0, -1e-3, 1e-3, 1.0])
    np.testing.assert_allclose(soft_occupancy(distance, 1e-5), [0, 0, 1, 1], atol=1e-6)
    # Far from a soft surface too, and without overflow.
    np.testing.assert_allclose(soft_occupancy(jnp.array([-1e6, 1e6]), 0.01), [0, 1])


def test_the_best_logit_is_distance_over_softness(x64):
    """Cross-entropy against the soft step has its least value there: its slope is zero."""
    distance = jnp.linspace(-0.03, 0.03, 13)
    target = soft_occupancy(distance, 0.004)
    slope = jax.vmap(jax.grad(binary_cross_entropy))(distance / 0.004, target)
    np.testing.assert_allclose(slope, 0.0, atol=1e-12)
