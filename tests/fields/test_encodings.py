"""Sines and cosines written out, and feature grids against interpolation by hand."""

from __future__ import annotations

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE, central_difference
from scipy.interpolate import RegularGridInterpolator

from xavatar_jax.fields import HashEncoding, positional_encoding


def test_positional_encoding_by_hand(x64):
    x = np.array([0.3, -1.2, 2.0])
    expected = [
        *x,
        *np.sin(x), *np.cos(x),
        *np.sin(2 * x), *np.cos(2 * x),
        *np.sin(4 * x), *np.cos(4 * x),
    ]  # fmt: skip
    np.testing.assert_allclose(positional_encoding(jnp.asarray(x), 3), expected, atol=1e-15)
    np.testing.assert_array_equal(positional_encoding(jnp.asarray(x), 0), x)
    assert positional_encoding(jnp.zeros(3), 4).shape == (27,)  # the paper's 27 and 54
    assert positional_encoding(jnp.zeros(6), 4).shape == (54,)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_positional_encoding_keeps_the_precision(x64, dtype):
    assert positional_encoding(jnp.zeros(3, dtype), 4).dtype == dtype


def dense_encoding(rng, spacing=(0.1, 0.05)):
    encoding = HashEncoding(
        np.array([-0.2, -0.1, 0.0]), np.array([0.2, 0.3, 0.3]),
        spacing=spacing, log2_size=14, key=jax.random.key(0),
    )  # fmt: skip
    table = jnp.asarray(rng.normal(size=encoding.table.shape), encoding.table.dtype)
    return eqx.tree_at(lambda e: e.table, encoding, table)


def test_a_dense_level_interpolates_trilinearly(x64, rng):
    encoding = dense_encoding(rng)
    assert (np.asarray(encoding.shapes) > 0).all()
    assert encoding.width == 4
    points = rng.uniform([-0.2, -0.1, 0.0], [0.2, 0.3, 0.3], (50, 3))
    found = jax.jit(jax.vmap(lambda p: encoding(p)))(points)
    for level, h in enumerate(encoding.spacing):
        shape, start = np.asarray(encoding.shapes)[level], int(encoding.offsets[level])
        origin = np.asarray(encoding.origin)
        values = np.asarray(encoding.table[start : start + np.prod(shape)]).reshape(*shape, 2)
        axes = [low + h * np.arange(n) for low, n in zip(origin, shape, strict=True)]
        expected = RegularGridInterpolator(axes, values)(points)
        np.testing.assert_allclose(found[:, level], expected, atol=1e-9)


def test_a_hashed_level_reads_the_rows_of_its_corners(x64, rng):
    """The eight rows by Instant NGP's hash, in Python integers."""
    encoding = HashEncoding(
        np.zeros(3), np.ones(3), spacing=(0.01,), features=3, log2_size=9, key=jax.random.key(1)
    )
    assert not np.asarray(encoding.shapes).any()
    assert encoding.table.shape == (512, 3)
    x = np.array([0.123, 0.456, 0.789])
    cell = np.floor(x / 0.01).astype(int)
    fraction = x / 0.01 - cell
    expected = np.zeros(3)
    for corner in itertools.product((0, 1), repeat=3):
        i, j, k = (int(c) for c in cell + corner)
        row = (i ^ (j * 2654435761 % 2**32) ^ (k * 805459861 % 2**32)) % 512
        share = np.prod([f if c else 1 - f for c, f in zip(corner, fraction, strict=True)])
        expected += share * np.asarray(encoding.table[row])
    np.testing.assert_allclose(encoding(jnp.asarray(x))[0], expected, atol=1e-12)


@pytest.mark.parametrize("log2_size", [14, 6], ids=["dense", "hashed"])
def test_features_are_continuous_across_cells(x64, rng, log2_size):
    encoding = HashEncoding(
        np.zeros(3), np.ones(3), spacing=(0.1,), log2_size=log2_size, scale=1.0,
        key=jax.random.key(2),
    )  # fmt: skip
    on_face = rng.uniform(0.1, 0.9, (60, 3))
    axis = rng.integers(0, 3, 60)
    on_face[np.arange(60), axis] = 0.1 * rng.integers(1, 9, 60)
    step = np.zeros((60, 3))
    step[np.arange(60), axis] = 1e-9
    run = jax.jit(jax.vmap(lambda p: encoding(p)))
    before, after = run(jnp.asarray(on_face - step)), run(jnp.asarray(on_face + step))
    np.testing.assert_allclose(before, after, atol=1e-6)


def test_outside_the_box_the_border_answers(rng):
    encoding = dense_encoding(rng)
    inside = encoding(jnp.array([0.0, 0.0, 0.0]))
    below = encoding(jnp.array([0.0, 0.0, -5.0]))
    np.testing.assert_allclose(below, inside, atol=TOLERANCE["float32_deep"])


def test_gradient_in_the_point_and_in_the_table(x64, rng):
    encoding = dense_encoding(rng)
    x = np.array([0.013, 0.127, 0.211])
    found = jax.jit(jax.jacrev(lambda v: encoding(v)))(x)
    expected = central_difference(jax.jit(lambda v: encoding(v)), x)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    slope = eqx.filter_jit(eqx.filter_grad(lambda e: jnp.sum(e(jnp.asarray(x)))))(encoding)
    # Interpolation weights of each level sum to one, for each of the two features.
    np.testing.assert_allclose(jnp.sum(slope.table), 4.0, atol=1e-12)
