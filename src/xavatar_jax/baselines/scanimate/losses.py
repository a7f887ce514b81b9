"""Terms of SCANimate's losses, of what the networks answered."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

_LEAST = 1e-6  # a power below one has no derivative at zero


def weight_error(weights: Float[Array, "*n J"], wanted: Float[Array, "*n J"]) -> Float[Array, ""]:
    """Mean squared difference of skinning weights."""
    return ((weights - wanted) ** 2).mean()


def sparsity(weights: Float[Array, "*n J"]) -> Float[Array, ""]:
    """Mean over points of $\\sum_j |w_j|^{0.8}$: least where one bone has all."""
    return (jnp.maximum(jnp.abs(weights), _LEAST) ** 0.8).sum(-1).mean()


def latent_size(latents: Float[Array, "*n k"]) -> Float[Array, ""]:
    """Mean length of latent vectors."""
    return jnp.sqrt((latents**2).sum(-1) + _LEAST**2).mean()


def cycle_error(points: Float[Array, "*n 3"], again: Float[Array, "*n 3"]) -> Float[Array, ""]:
    """Mean absolute difference of coordinates, metres: there and back."""
    return jnp.abs(points - again).mean()


def edge_difference(weights: Float[Array, "*n 3 J"]) -> Float[Array, ""]:
    """Mean over the edges of triangles of $\\sum_j |w_j(a) - w_j(b)|$."""
    return jnp.abs(weights - jnp.roll(weights, 1, axis=-2)).sum(-1).mean()


def normal_error(gradient: Float[Array, "*n 3"], normal: Float[Array, "*n 3"]) -> Float[Array, ""]:
    """Mean length of the difference between a gradient and the outward normal."""
    return jnp.sqrt(((gradient - normal) ** 2).sum(-1) + _LEAST**2).mean()


def eikonal_error(gradient: Float[Array, "*n 3"]) -> Float[Array, ""]:
    """Mean of $(|g| - 1)^2$ (Gropp et al., 2020)."""
    return ((jnp.sqrt((gradient**2).sum(-1) + _LEAST**2) - 1) ** 2).mean()


def nearness(distance: Float[Array, "*n"]) -> Float[Array, ""]:
    """Mean of $e^{-100 |d|}$, distances in metres: how much surface is where none should be."""
    return jnp.exp(-100 * jnp.abs(distance)).mean()


def wrong_side(distance: Float[Array, "*n"]) -> Float[Array, ""]:
    """Mean depth of points that should be outside; distances are positive outside."""
    return jnp.maximum(-distance, 0).mean()
