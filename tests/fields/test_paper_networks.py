"""The paper's networks: sizes, the forward pass in plain NumPy, and how they start."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE, TREES, central_difference

from xavatar_jax.body import BodyParams
from xavatar_jax.fields import (
    PAPER_SKINNING,
    ImplicitMLP,
    MLPGeometry,
    MLPShape,
    MLPSkinning,
    WeightNormLinear,
    sharp_softplus,
)

SMPL_GEOMETRY = MLPShape(
    width=256, depth=8, octaves=0, skip=(4,), condition_at=(4,), condition_embedding=8
)


def scalars(network):
    """Trainable numbers without the weight-norm magnitudes, as the paper's table counts them."""
    total = sum(layer.direction.size + layer.bias.size for layer in network.layers)
    if network.embedding is not None:
        total += network.embedding.size + network.embedding_bias.size
    return total


def reference(network, x, condition=None):
    """The network from its definition, in float64, layer by layer."""
    shape = network.shape
    a64 = lambda v: np.asarray(v, np.float64)  # noqa: E731
    encoded = [x]
    for octave in range(shape.octaves):
        encoded += [np.sin(2.0**octave * x), np.cos(2.0**octave * x)]
    encoded = np.concatenate(encoded)
    if condition is not None:
        condition = a64(network.embedding) @ condition + a64(network.embedding_bias)
    h = encoded
    for k, layer in enumerate(network.layers):
        if k in shape.condition_at and condition is not None:
            h = np.concatenate([h, condition])
        if k in shape.skip:
            h = np.concatenate([h, encoded]) / np.sqrt(2)
        direction = a64(layer.direction)
        weight = direction * (a64(layer.length) / np.linalg.norm(direction, axis=1))[:, None]
        h = weight @ h + a64(layer.bias)
        if k < shape.depth:
            h = np.logaddexp(0, 100 * h) / 100
    return h


def test_sizes_of_the_published_networks():
    def shapes(make):  # nothing is drawn: only shapes are asked for
        return eqx.filter_eval_shape(lambda key: make(key=key), jax.random.key(0)).mlp

    def geometry(key):
        return MLPGeometry(TREES["smplx"], 10, MLPShape(), key=key)

    four = MLPShape(width=128, depth=4, octaves=0, skip=(), condition_at=())
    published = {
        1_848_966: geometry,
        74_171: partial(MLPSkinning, TREES["smplx"]),
        463_662: partial(MLPGeometry, TREES["smpl"], 0, SMPL_GEOMETRY),
        53_273: partial(MLPSkinning, TREES["smpl"], four),
    }
    for count, make in published.items():
        assert scalars(shapes(make)) == count
    network = shapes(geometry)
    widths = [layer.direction.shape for layer in network.layers]
    assert widths[0] == (512, 27 + 16)
    assert widths[3] == (512 - 27, 512)
    assert widths[4] == (512, 512)
    assert widths[8] == (1, 512)
    assert (PAPER_SKINNING.width, PAPER_SKINNING.depth) == (128, 5)


@pytest.mark.parametrize(
    ("shape", "init"),
    [
        (MLPShape(width=48, depth=8), "ball"),
        (MLPShape(width=32, depth=4, octaves=2, skip=(2,), condition_at=(0, 2)), "default"),
        (MLPShape(24, 3, octaves=0, skip=(), condition_at=(1,), condition_embedding=5), "default"),
    ],
    ids=["paper", "skip_and_condition", "plain"],
)
def test_forward_pass_agrees_with_numpy(x64, rng, init, shape):
    network = ImplicitMLP(shape, outputs=2, condition=7, init=init, key=jax.random.key(1))
    # Lengths of their own: weight normalisation must be seen.
    layers = tuple(
        WeightNormLinear(layer.direction, layer.bias + 0.01 * rng.normal(size=layer.bias.shape))
        for layer in network.layers
    )
    for layer in layers:
        object.__setattr__(layer, "length", layer.length * rng.uniform(0.5, 2, layer.length.shape))
    object.__setattr__(network, "layers", layers)
    run = jax.jit(lambda x, c: network(x, c))
    for _ in range(5):
        x, condition = rng.normal(size=3), rng.normal(size=7)
        out = run(jnp.asarray(x), jnp.asarray(condition))
        np.testing.assert_allclose(out, reference(network, x, condition), rtol=1e-11, atol=1e-12)


def test_the_full_geometry_network_in_single_precision(rng):
    field = MLPGeometry(TREES["smplx"], 10, MLPShape(), key=jax.random.key(2))
    body_pose, expression = rng.normal(size=(55, 3)), rng.normal(size=10)
    params = BodyParams(
        pose=jnp.asarray(body_pose, jnp.float32),
        betas=jnp.zeros(10),
        expression=jnp.asarray(expression, jnp.float32),
        transl=jnp.zeros(3),
        tree=TREES["smplx"],
    )
    condition = field.condition(params)
    # Body pose over pi, then expression: neither root, jaw, eyes nor hands.
    expected = np.concatenate([body_pose[1:22].ravel() / np.pi, expression])
    np.testing.assert_allclose(condition, expected, rtol=1e-6)
    x = rng.uniform(-1, 1, (4, 3))
    found = jax.jit(jax.vmap(lambda v: field(v, condition).level))(jnp.asarray(x, jnp.float32))
    expected = [reference(field.mlp, p, np.asarray(condition, np.float64))[0] for p in x]
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["float32_deep"] * 5)


def test_a_hand_alone_is_conditioned_on_its_own_pose():
    field = MLPGeometry(TREES["mano"], 0, MLPShape(width=40, depth=2), key=jax.random.key(0))
    assert field.joints == tuple(range(1, 16))


def test_softplus_is_sharp_and_does_not_overflow(x64):
    x = np.array([-1e4, -1.0, -1e-3, 0.0, 1e-3, 1.0, 1e4])
    np.testing.assert_allclose(sharp_softplus(jnp.asarray(x)), np.logaddexp(0, 100 * x) / 100)
    slope = jax.vmap(jax.grad(sharp_softplus))(jnp.asarray(x))
    np.testing.assert_allclose(slope, 0.5 * (1 + np.tanh(50 * x)), atol=1e-12)


def test_weight_norm_is_blind_to_the_length_of_the_direction(x64, rng):
    layer = WeightNormLinear(jnp.asarray(rng.normal(size=(4, 5))), jnp.zeros(4))
    x = jnp.asarray(rng.normal(size=5))
    np.testing.assert_allclose(layer(x), layer.direction @ x, rtol=1e-12)
    longer = WeightNormLinear(3 * layer.direction, layer.bias)
    object.__setattr__(longer, "length", layer.length)
    np.testing.assert_allclose(longer(x), layer(x), rtol=1e-12)


@pytest.fixture(scope="module")
def ball():
    return MLPGeometry(TREES["smplx"], 10, MLPShape(), key=jax.random.key(3))


def test_statistics_of_the_ball(ball):
    for k, layer in enumerate(ball.mlp.layers):
        weight = np.asarray(layer.direction)
        if k == 8:
            np.testing.assert_allclose(weight.mean(), -np.sqrt(np.pi / 512), rtol=1e-3)
            np.testing.assert_allclose(weight.std(), 1e-4, rtol=0.2)
            np.testing.assert_array_equal(layer.bias, 1.0)
            continue
        assert not np.asarray(layer.bias).any()
        heard = {0: slice(0, 3), 4: slice(0, 488)}.get(k, slice(None))
        silent = {0: slice(3, None), 4: slice(488, None)}.get(k, slice(0, 0))
        assert not weight[:, silent].any()  # octaves, and at layer 0 the condition too
        expected = np.sqrt(2 / weight.shape[0])
        np.testing.assert_allclose(weight[:, heard].std(), expected, rtol=0.05)
        assert abs(weight[:, heard].mean()) < 0.05 * expected


def test_the_start_is_a_ball_that_hears_neither_octaves_nor_condition(ball, rng):
    directions = rng.normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    run = jax.jit(
        jax.vmap(jax.vmap(lambda x, c: ball(x, c).level, in_axes=(0, None)), in_axes=(0, None))
    )
    radii = np.array([0.0, 0.3, 0.5, 1.8, 2.5])
    points = jnp.asarray(radii[:, None, None] * directions, jnp.float32)
    still = np.asarray(run(points, jnp.zeros(73)))
    assert (still[:3] > 0).all()  # positive inside
    assert (still[3:] < 0).all()
    assert (np.diff(still, axis=0) < 0).all()
    moved = run(points, jnp.asarray(rng.normal(size=73), jnp.float32))
    np.testing.assert_array_equal(moved, still)


@pytest.mark.parametrize("kind", ["smplx", "mano"])
def test_gradients_of_the_skinning_network(x64, rng, kind):
    field = MLPSkinning(TREES[kind], MLPShape(16, 2, 0, (), ()), key=jax.random.key(4))
    x = rng.normal(size=3)
    found = jax.jit(jax.jacfwd(lambda v: field(v)))(jnp.asarray(x))
    run = jax.jit(lambda v: field(v))
    expected = central_difference(lambda v: run(jnp.asarray(v)), x)
    np.testing.assert_allclose(found, expected, atol=TOLERANCE["difference"])
    np.testing.assert_allclose(jnp.sum(run(jnp.asarray(x))), 1.0, atol=1e-12)
    assert bool(field.covers(jnp.asarray(x)))
    assert not bool(field.covers(jnp.full(3, jnp.nan)))


@pytest.mark.parametrize("count", [0, 4, 50])
def test_motions_may_have_other_coefficients_of_expression(rng, count):
    """What is missing is zero, and what is more is left out."""
    field = MLPGeometry(TREES["smplx"], 10, MLPShape(width=48), key=jax.random.key(2))
    pose, expression = rng.normal(size=(55, 3)), rng.normal(size=count)
    ten = np.resize(np.append(expression, np.zeros(10)), 10) if count < 10 else expression[:10]

    def condition(values):
        values = jnp.asarray(values, jnp.float32)
        return field.condition(
            BodyParams(
                pose=jnp.asarray(pose, jnp.float32),
                betas=jnp.zeros(10),
                expression=values,
                transl=jnp.zeros(3),
                tree=TREES["smplx"],
            )
        )

    assert np.array_equal(condition(expression), condition(ten))
