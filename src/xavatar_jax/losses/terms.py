"""Elementwise loss terms."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float


def binary_cross_entropy(
    logit: Float[Array, "*n"], target: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """$-y \\log\\sigma(z) - (1 - y) \\log(1 - \\sigma(z))$, stable for any logit.

    Targets lie in [0, 1] and need not be 0 or 1.

    **Raises:** `ValueError` if the shapes differ.
    """
    _same_shape(logit, target)
    # Not max(z, 0) + log1p(exp(-|z|)): its derivative at zero is not that of the loss.
    return jax.nn.softplus(logit) - logit * target


def squared_error(value: Float[Array, "*n"], target: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """$(v - t)^2$. **Raises:** `ValueError` if the shapes differ."""
    _same_shape(value, target)
    return (value - target) ** 2


def soft_occupancy(distance: Float[Array, "*n"], softness: float) -> Float[Array, "*n"]:
    """Occupancy of a point at a signed distance (positive inside, metres).

    With `softness` 0 it is 0 or 1. Otherwise the surface is a logistic step that is `softness`
    metres wide: cross-entropy against it is least where the logit is distance over softness, so
    that one point near the surface says where the surface is, not only on which side.
    """
    if softness == 0:
        return (distance > 0).astype(distance.dtype)
    return jax.nn.sigmoid(distance / softness)


def _same_shape(a: Array, b: Array) -> None:
    if a.shape != b.shape:
        raise ValueError(f"shapes differ: {a.shape} and {b.shape}")
