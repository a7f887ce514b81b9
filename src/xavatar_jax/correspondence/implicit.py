"""Gradients through a root, by the implicit function theorem."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..fields import AbstractSkinningField, skin_with_jacobian
from ..kinematics import determinant_3x3, solve_3x3

# Below this the map folds: the root's derivative grows without bound, so none is given.
MIN_DETERMINANT = 0.05


def implicit_root(
    x_c: Float[Array, "3"],
    x_d: Float[Array, "3"],
    field: AbstractSkinningField,
    transforms: Float[Array, "J 4 4"],
) -> tuple[Float[Array, "3"], Float[Array, " J"], Bool[Array, ""]]:
    r"""A found root, differentiable in field, transforms and `x_d`.

    One Newton step $\hat x = x^* - J^{-1}(d(x^*) - x_d)$ with $x^*$ and $J$ held constant has the
    derivatives of the implicit function theorem (X-Avatar, eq. 3; SNARF). A step before it takes
    the root that was found to $x^*$: derivatives change over millimetres, and those at a root that
    is 1e-5 m off are off by some per cent near a fold.

    Returns the point, the weights there, and whether the map is regular: where $|\det J|$ is
    below `MIN_DETERMINANT`, the point has no derivatives.
    """
    nearer, _, _ = _newton(x_c, x_d, field, transforms)
    return _newton(jax.lax.stop_gradient(nearer), x_d, field, transforms)


def _newton(
    x_c: Array, x_d: Array, field: AbstractSkinningField, transforms: Array
) -> tuple[Array, Array, Array]:
    """One step from a point held constant, by a Jacobian held constant."""
    posed, jacobian, weights = skin_with_jacobian(field, x_c, transforms)
    jacobian = jax.lax.stop_gradient(jacobian)
    regular = jnp.abs(determinant_3x3(jacobian)) >= MIN_DETERMINANT
    # The inverse of a stand-in where it is singular: no NaN may enter the backward pass.
    safe = jnp.where(regular, jacobian, jnp.eye(3, dtype=jacobian.dtype))
    step = solve_3x3(safe, posed - x_d)
    return x_c - jnp.where(regular, step, 0.0), weights, regular
