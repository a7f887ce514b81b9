"""The paper's network: weight-normalised layers, softplus, skip and condition inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .encodings import positional_encoding

_SOFTPLUS_SHARPNESS = 100.0


def sharp_softplus(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Softplus with $\\beta = 100$: a ReLU with second derivatives."""
    return jax.nn.softplus(_SOFTPLUS_SHARPNESS * x) / _SOFTPLUS_SHARPNESS


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
