"""Gradients through a root, by the implicit function theorem."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..fields import AbstractSkinningField, skin_with_jacobian
from ..kinematics import inverse_3x3

# Below this the map folds: the root's derivative grows without bound, so none is given.
MIN_DETERMINANT = 0.05


def implicit_root(
    x_c: Float[Array, "3"],
    x_d: Float[Array, "3"],
    field: AbstractSkinningField,
    transforms: Float[Array, "J 4 4"],
) -> tuple[Float[Array, "3"], Float[Array, " J"], Bool[Array, ""]]:
    r"""One Newton step from a found root, differentiable in field, transforms and `x_d`.

    $\hat x = x^* - J^{-1}(d(x^*) - x_d)$ with $x^*$ and $J$ held constant: its value polishes the
    root, its derivatives are those of the implicit function theorem (X-Avatar, eq. 3; SNARF).
    Returns the point, the weights there, and whether the map is regular: where $|\det J|$ is
    below `MIN_DETERMINANT`, the point comes back as it was, without derivatives.
    """
    x_c = jax.lax.stop_gradient(x_c)
    posed, jacobian, weights = skin_with_jacobian(field, x_c, transforms)
    jacobian = jax.lax.stop_gradient(jacobian)
    regular = jnp.abs(determinant(jacobian)) >= MIN_DETERMINANT
    # The inverse of a stand-in where it is singular: no NaN may enter the backward pass.
    safe = jnp.where(regular, jacobian, jnp.eye(3, dtype=jacobian.dtype))
    step = (inverse_3x3(safe) * (posed - x_d)).sum(-1)
    return x_c - jnp.where(regular, step, 0.0), weights, regular


def determinant(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """Determinant of 3x3 matrices in closed form."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    return jnp.sum(a * jnp.cross(b, c), axis=-1)
