"""Networks: softplus, positional encoding, and the paper's weight-normalised MLP."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .roles import misshapen

# log(1 + u) for u from 0 to 1, to 6e-9: below what float32 holds.
_LOG1P = (
    np.polynomial.chebyshev.Chebyshev.interpolate(np.log1p, 9, [0, 1])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def softplus(x: Float[Array, "..."], sharpness: float = 1.0) -> Float[Array, "..."]:
    """$\\log(1 + e^{\\beta x}) / \\beta$ with $\\beta$ = `sharpness`, for finite `x`."""
    if x.dtype != jnp.float32:
        return jax.nn.softplus(sharpness * x) / sharpness
    u = jnp.exp(-sharpness * jnp.abs(x))
    log = jnp.full_like(u, _LOG1P[-1])
    for coefficient in _LOG1P[-2::-1]:
        log = log * u + jnp.asarray(coefficient, u.dtype)
    return jnp.maximum(x, 0) + log / sharpness


@softplus.defjvp
def _softplus_jvp(sharpness: float, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (x,), (t,) = primals, tangents
    return softplus(x, sharpness), jax.nn.sigmoid(sharpness * x) * t


def positional_encoding(x: Float[Array, " n"], octaves: int) -> Float[Array, " m"]:
    """$[x, \\sin 2^0 x, \\cos 2^0 x, \\dots, \\cos 2^{L-1} x]$ with L `octaves`, raw input first.

    No factor of pi, as in X-Avatar's released code. Width n (1 + 2 L).
    """
    if octaves == 0:
        return x
    scaled = x[None, :] * (2.0 ** np.arange(octaves))[:, None].astype(x.dtype)
    waves = jnp.stack([jnp.sin(scaled), jnp.cos(scaled)], axis=1)
    return jnp.concatenate([x, waves.reshape(-1)])


def sharp_softplus(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Softplus with $\\beta = 100$: a ReLU with second derivatives."""
    return softplus(x, 100.0)


class WeightNormLinear(eqx.Module):
    """A linear layer with a direction and a separate length for each row (Salimans & Kingma,
    2016)."""

    direction: Float[Array, "out in"]
    length: Float[Array, " out"]
    bias: Float[Array, " out"]

    def __init__(self, weight: Float[Array, "out in"], bias: Float[Array, " out"]):
        self.direction = weight
        self.length = jnp.linalg.norm(weight, axis=1)
        self.bias = bias

    def __call__(self, x: Float[Array, " in"]) -> Float[Array, " out"]:
        norm = jnp.sqrt(jnp.sum(self.direction**2, axis=1))
        return (self.direction @ x) * (self.length / norm) + self.bias

    def faults(self) -> Iterator[tuple[str, str]]:
        """Leaves that do not fit one another: see `check_model`."""
        rows = len(self.direction)
        yield from misshapen(self, direction=(None, None), length=(rows,), bias=(rows,))


@dataclass(frozen=True)
class MLPShape:
    """Sizes of an `ImplicitMLP`; `skip` and `condition_at` are numbers of layers, from 0.

    The defaults are the SMPL-X geometry network of X-Avatar.
    """

    width: int = 512
    depth: int = 8
    octaves: int = 4
    skip: tuple[int, ...] = (4,)
    condition_at: tuple[int, ...] = (0,)
    condition_embedding: int = 16


class ImplicitMLP(eqx.Module):
    """`depth` hidden layers on an encoded point, with a linearly embedded condition.

    A skip layer reads $[h, \\gamma(x)]/\\sqrt2$, and the layer before it is narrower by the width
    of $\\gamma(x)$. `init="ball"` starts as a ball of radius about one, positive inside (Atzmon &
    Lipman, 2020), with octaves and condition silent; `"default"` draws uniformly by fan-in.
    """

    layers: tuple[WeightNormLinear, ...]
    embedding: Float[Array, "embedded raw"] | None
    embedding_bias: Float[Array, " embedded"] | None
    shape: MLPShape = eqx.field(static=True)

    def __init__(
        self,
        shape: MLPShape,
        *,
        inputs: int = 3,
        outputs: int = 1,
        condition: int = 0,
        init: Literal["ball", "default"] = "default",
        key: PRNGKeyArray,
    ):
        self.shape = shape
        keys = jax.random.split(key, shape.depth + 2)
        encoded = inputs * (1 + 2 * shape.octaves)
        embedded = min(shape.condition_embedding, condition) if condition else 0
        self.embedding = self.embedding_bias = None
        if condition:
            bound = 1 / np.sqrt(condition)
            draws = jax.random.uniform(
                keys[-1], (embedded, condition + 1), minval=-bound, maxval=bound
            )
            self.embedding, self.embedding_bias = draws[:, :-1], draws[:, -1]
        layers = []
        for k in range(shape.depth + 1):
            fan_in = encoded if k == 0 else shape.width
            if k in shape.condition_at:
                # A skip layer stays as wide as the others: the condition comes on top.
                fan_in += embedded
            fan_out = outputs if k == shape.depth else shape.width
            if k + 1 in shape.skip:
                fan_out -= encoded
            if init == "ball":
                weight, bias = _ball_layer(
                    keys[k], k, shape, fan_in, fan_out, inputs=inputs, encoded=encoded
                )
            else:
                bound = 1 / np.sqrt(fan_in)
                draws = jax.random.uniform(
                    keys[k], (fan_out, fan_in + 1), minval=-bound, maxval=bound
                )
                weight, bias = draws[:, :-1], draws[:, -1]
            layers.append(WeightNormLinear(weight, bias))
        self.layers = tuple(layers)

    def __call__(
        self, x: Float[Array, " n"], condition: Float[Array, " c"] | None = None
    ) -> Float[Array, " out"]:
        """The outputs for one point."""
        encoded = positional_encoding(x, self.shape.octaves)
        if self.embedding is not None:
            assert condition is not None
            assert self.embedding_bias is not None
            condition = self.embedding @ condition + self.embedding_bias
        h = encoded
        for k, layer in enumerate(self.layers):
            if k in self.shape.condition_at and condition is not None:
                h = jnp.concatenate([h, condition])
            if k in self.shape.skip:
                h = jnp.concatenate([h, encoded]) / np.sqrt(2).astype(x.dtype)
            h = layer(h)
            if k < self.shape.depth:
                h = sharp_softplus(h)
        return h


def _ball_layer(
    key: PRNGKeyArray,
    k: int,
    shape: MLPShape,
    fan_in: int,
    fan_out: int,
    *,
    inputs: int,
    encoded: int,
) -> tuple[Array, Array]:
    if k == shape.depth:
        mean = -np.sqrt(np.pi) / np.sqrt(fan_in)
        weight = mean + 1e-4 * jax.random.normal(key, (fan_out, fan_in))
        return weight, jnp.ones(fan_out)
    weight = jax.random.normal(key, (fan_out, fan_in)) * np.sqrt(2) / np.sqrt(fan_out)
    if shape.octaves:
        if k == 0:
            weight = weight.at[:, inputs:].set(0)
        elif k in shape.skip:
            weight = weight.at[:, fan_in - encoded + inputs :].set(0)
    return weight, jnp.zeros(fan_out)
