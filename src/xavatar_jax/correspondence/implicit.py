"""Gradients through a root, by the implicit function theorem."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..fields import AbstractSkinningField, skin_with_jacobian
from ..kinematics import determinant_3x3, solve_3x3

MIN_DETERMINANT = 0.05
"""Below this the map is about to fold and the root's derivative grows without bound."""


def is_regular(jacobian: Float[Array, "*batch 3 3"]) -> Bool[Array, "*batch"]:
    r"""Whether a root with this Jacobian has derivatives: $|\det J|$ at least `MIN_DETERMINANT`."""
    return jnp.abs(determinant_3x3(jacobian)) >= MIN_DETERMINANT


def newton_step(
    jacobian: Float[Array, "3 3"], residual: Float[Array, "3"], ok: Bool[Array, ""]
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Solve for a step with the Jacobian held constant; zero, without derivatives, where irregular.

    Returns the step and whether the Jacobian is regular and the input `ok`.
    """
    jacobian = jax.lax.stop_gradient(jacobian)
    regular = ok & is_regular(jacobian)
    # A dummy matrix where it is irregular: no NaN may enter the backward pass.
    safe = jnp.where(regular, jacobian, jnp.eye(3, dtype=jacobian.dtype))
    return jnp.where(regular, solve_3x3(safe, residual), 0.0), regular


def implicit_root(
    x_c: Float[Array, "3"],
    x_d: Float[Array, "3"],
    field: AbstractSkinningField,
    transforms: Float[Array, "J 4 4"],
) -> tuple[Float[Array, "3"], Float[Array, " J"], Bool[Array, ""]]:
    r"""A root, differentiable in field, transforms and `x_d`.

    One Newton step $\hat x = x^* - J^{-1}(d(x^*) - x_d)$ with $x^*$ and $J$ held constant has the
    derivatives of the implicit function theorem (X-Avatar, eq. 3; SNARF). A first step takes
    `x_c` to $x^*$: derivatives change over millimetres, and at a root that is 1e-5 m off they are
    off by some per cent near a fold.

    Returns the point, the weights there, and whether the root is regular (`is_regular`). Where it
    is not, or the input is not finite, the point has no derivatives.
    """
    finite = jnp.all(jnp.isfinite(x_c)) & jnp.all(jnp.isfinite(x_d))
    # A dummy point: its derivatives are zero, where those of NaN would be NaN for field and bones.
    place, target = jnp.where(finite, x_c, 0.0), jnp.where(finite, x_d, 0.0)

    def step(x: Array) -> tuple[Array, Array, Array]:
        posed, jacobian, weights = skin_with_jacobian(field, x, transforms)
        move, regular = newton_step(jacobian, posed - target, finite)
        return x - move, weights, regular

    nearer, _, _ = step(place)
    root, weights, regular = step(jax.lax.stop_gradient(nearer))
    return jnp.where(finite, root, jax.lax.stop_gradient(x_c)), weights, regular
