"""The fields of an avatar at many canonical points: jitted, in batches of one size."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..correspondence.batched import CHUNK
from ..kinematics import skin_points
from ..training import AvatarFields, FitConfig

PROJECT_STEPS, PROJECT_STEP = 3, 0.003  # metres


def batch_size(config: FitConfig) -> int:
    """Points a batch: what the geometry field's own memory allows."""
    return 16_384 if config.geometry.kind == "hash" else 4096


@eqx.filter_jit
def skin_weights(fields: AvatarFields, points: Array) -> Array:
    return jax.vmap(fields.skinning)(points)


@eqx.filter_jit
def logits(fields: AvatarFields, points: Array, condition: Any) -> Array:
    return jax.vmap(lambda x: fields.geometry(x, condition))(points)


@eqx.filter_jit
def gradients(fields: AvatarFields, points: Array, condition: Any) -> Array:
    return jax.vmap(jax.grad(lambda x: fields.geometry(x, condition)))(points)


@eqx.filter_jit
def project(fields: AvatarFields, points: Array, condition: Any) -> Array:
    """Move places of the neutral surface on to a condition's, from where it carries them.

    By `PROJECT_STEPS` Newton steps along the gradient, `PROJECT_STEP` at most each.
    """

    def value(x: Array) -> Array:
        return fields.geometry(x, condition)

    def step(_: int, x: Array) -> Array:
        f, g = jax.value_and_grad(value)(x)
        slope = jnp.sqrt(jnp.sum(g**2) + 1e-12)
        return x - g / slope * jnp.clip(f / slope, -PROJECT_STEP, PROJECT_STEP)

    def one(x: Array) -> Array:
        return jax.lax.fori_loop(0, PROJECT_STEPS, step, fields.geometry.carry(x, condition))

    return jax.vmap(one)(points)


@eqx.filter_jit
def skin(fields: AvatarFields, points: Array, transforms: Array) -> Array:
    return jax.vmap(lambda x: skin_points(x, fields.skinning(x), transforms))(points)


def padded_size(count: int) -> int:
    """The next of few sizes: powers of two from 256, then multiples of a search's chunk."""
    return count + -count % CHUNK if count > CHUNK else max(256, 1 << (count - 1).bit_length())


def in_batches(function: Any, points: np.ndarray, batch: int) -> np.ndarray:
    """Apply a jitted function to fixed-size batches, the last one padded: no retracing."""
    count = len(points)
    padded = np.concatenate([points, np.repeat(points[:1], -count % batch, axis=0)])
    parts = [
        np.asarray(function(jnp.asarray(padded[k : k + batch], jnp.float32)))
        for k in range(0, len(padded), batch)
    ]
    return np.concatenate(parts)[:count]
