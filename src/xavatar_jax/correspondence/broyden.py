"""Broyden's method as an optimistix root finder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree, Scalar


class BroydenState(eqx.Module):
    """Residual at the current iterate and the inverse-Jacobian estimate in use there."""

    residual: Float[Array, " n"]
    inverse_jacobian: Float[Array, "n n"]


class Broyden(optx.AbstractRootFinder):
    """Broyden's good method for small dense systems, one function call a step.

    Keeps an estimate of the inverse Jacobian and updates it by rank one so that it maps the last
    change of the residual to the last step (Broyden, 1965). `options["inverse_jacobian"]` gives
    the first estimate; without it the Jacobian at the first iterate is inverted.

    - `atol`: converged when the norm of the residual is below it. `rtol` is not used by a root
      finder (zero times it is zero) and stands for the interface.
    - `divergence`: given up when the norm reaches it.
    - `guard`: added to the denominator of the update, with its sign.

    Works with any pytree of arrays through `optimistix.root_find`, under `jit`, `vmap` and, by
    an adjoint, `grad`. The residual in the returned state belongs to the iterate returned.
    """

    rtol: float = 0.0
    atol: float = 1e-5
    divergence: float = float("inf")
    guard: float = 1e-6
    norm: Callable[[PyTree], Scalar] = optx.two_norm

    def init(
        self,
        fn: Callable,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        f_struct: PyTree,
        aux_struct: PyTree,
        tags: frozenset[object],
    ) -> BroydenState:
        del f_struct, aux_struct, tags
        flat_y, unravel = ravel_pytree(y)

        def flat_fn(v: Array) -> Array:
            return ravel_pytree(fn(unravel(v), args)[0])[0]

        residual = flat_fn(flat_y)
        if residual.shape != flat_y.shape:
            raise ValueError(
                f"Broyden needs as many equations as unknowns: {residual.size} for {flat_y.size}"
            )
        inverse = options.get("inverse_jacobian")
        if inverse is None:
            inverse = jnp.linalg.inv(jax.jacfwd(flat_fn)(flat_y))
        inverse = jnp.asarray(inverse, residual.dtype)
        if inverse.shape != (flat_y.size, flat_y.size):
            raise ValueError(
                f"options['inverse_jacobian'] has shape {inverse.shape}, "
                f"expected {(flat_y.size, flat_y.size)}"
            )
        return BroydenState(residual, inverse)

    def step(
        self,
        fn: Callable,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: BroydenState,
        tags: frozenset[object],
    ) -> tuple[PyTree, BroydenState, PyTree]:
        del options, tags
        flat_y, unravel = ravel_pytree(y)
        inverse = state.inverse_jacobian
        step = -_apply(inverse, state.residual)
        new_y = unravel(flat_y + step)
        value, aux = fn(new_y, args)
        residual = ravel_pytree(value)[0]
        change = residual - state.residual
        row = _apply(inverse.T, step)
        denominator = jnp.sum(row * change)
        denominator = denominator + jnp.where(denominator < 0, -self.guard, self.guard)
        update = (step - _apply(inverse, change)) / denominator
        return new_y, BroydenState(residual, inverse + update[:, None] * row[None, :]), aux

    def terminate(
        self,
        fn: Callable,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: BroydenState,
        tags: frozenset[object],
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        del fn, y, args, options, tags
        return stopping_rule(self.norm(state.residual), self.atol, self.divergence)

    def postprocess(
        self,
        fn: Callable,
        y: PyTree,
        aux: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: BroydenState,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[PyTree, PyTree, dict[str, Any]]:
        del fn, args, options, tags, result
        return y, aux, {"residual_norm": self.norm(state.residual)}


def stopping_rule(
    residual: Float[Array, ""], atol: float, divergence: float
) -> tuple[Bool[Array, ""], optx.RESULTS]:
    """Stop on convergence, divergence or a value that is not finite, and say which."""
    finite = jnp.isfinite(residual)
    converged = residual < atol
    diverged = residual >= divergence
    result = optx.RESULTS.where(
        finite,
        optx.RESULTS.where(
            diverged & ~converged, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        ),
        optx.RESULTS.nonfinite,
    )
    return converged | diverged | ~finite, result


def _apply(matrix: Float[Array, "n m"], vector: Float[Array, " m"]) -> Float[Array, " n"]:
    # A sum, not a matrix product: tiny, and never in reduced precision.
    return (matrix * vector).sum(-1)
