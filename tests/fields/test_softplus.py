"""The fast softplus against NumPy's own logarithms, and its derivatives against theirs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xavatar_jax.fields.networks import softplus


@pytest.mark.parametrize("sharpness", [1.0, 10.0, 100.0])
def test_softplus_and_two_derivatives(sharpness):
    x = np.concatenate([np.linspace(-3, 3, 1001), [0.0, -80.0, 80.0]])
    expected = np.logaddexp(0, sharpness * x) / sharpness
    share = 0.5 * (1 + np.tanh(0.5 * sharpness * x))
    points = jnp.asarray(x, jnp.float32)
    value, slope = jax.vmap(jax.value_and_grad(lambda v: softplus(v, sharpness)))(points)
    np.testing.assert_allclose(value, expected, rtol=3e-7, atol=2e-8)
    np.testing.assert_allclose(slope, share, atol=3e-5 * sharpness / 100 + 1e-6)
    bend = jax.vmap(jax.grad(jax.grad(lambda v: softplus(v, sharpness))))(points)
    np.testing.assert_allclose(bend, sharpness * share * (1 - share), atol=1e-3 * sharpness)


@pytest.mark.parametrize("sharpness", [1.0, 10.0, 100.0])
def test_softplus_in_float64_is_exact(x64, sharpness):
    x = np.linspace(-8, 8, 4001)
    expected = np.logaddexp(0, sharpness * x) / sharpness
    np.testing.assert_allclose(
        softplus(jnp.asarray(x), sharpness), expected, rtol=1e-13, atol=1e-14
    )
