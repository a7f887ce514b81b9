"""Root finders for `optimistix`: Broyden's method, and Newton's for maps with a known Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from ..kinematics import solve_3x3


class AbstractRootState(eqx.Module):
    """A solver state that holds the residual at the current iterate.

    Batched solves read it from there; for other solvers they evaluate the function once more.
    """

    residual: eqx.AbstractVar[Float[Array, " n"]]


class BroydenState(AbstractRootState):
    """Residual and estimate of the inverse Jacobian at the current iterate."""

    residual: Float[Array, " n"]
    inverse_jacobian: Float[Array, "n n"]


class Broyden(optx.AbstractRootFinder):
    """Broyden's good method for small dense systems, with one function call per step.

    Keeps an estimate of the inverse Jacobian, with a rank-one update after each step so that it
    maps the last change of the residual to the last step (Broyden, 1965).
    `options["inverse_jacobian"]` gives the first estimate; by default it is the inverse of the
    Jacobian at the first iterate.

    - `atol`: converged when the norm of the residual is below it. `rtol` is unused.
    - `divergence`: give up when the norm reaches it.
    - `guard`: smallest size of the update's denominator, relative to the squared step.

    Works on any pytree of arrays through `optimistix.root_find`, under `jit`, `vmap` and, with an
    adjoint, `grad`. The residual in the returned state belongs to the returned iterate.
    """

    rtol: float = 0.0
    atol: float = 1e-5
    divergence: float = float("inf")
    guard: float = 1e-4
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
        least = jnp.maximum(self.guard * jnp.sum(step**2), jnp.finfo(step.dtype).tiny)
        small = jnp.abs(denominator) < least
        denominator = jnp.where(small, jnp.where(denominator < 0, -least, least), denominator)
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


class NewtonState(AbstractRootState):
    """Residual and Jacobian at the current iterate."""

    residual: Float[Array, "3"]
    jacobian: Float[Array, "3 3"]


class ClosedFormNewton(optx.AbstractRootFinder):
    """Newton's method for `fn(y, args) -> (residual, jacobian)` with three unknowns.

    The function returns its Jacobian as auxiliary output (`has_aux=True`): on a grid it costs the
    same eight reads as the value. The 3x3 inverse is in closed form. Steps are limited to
    `max_step` metres, since a full step may overshoot at a kink between cells.
    """

    rtol: float = 0.0
    atol: float = 1e-5
    divergence: float = float("inf")
    max_step: float = 0.3
    norm: Callable[[PyTree], Scalar] = optx.two_norm

    def init(
        self,
        fn: Callable,
        y: Float[Array, "3"],
        args: PyTree,
        options: dict[str, Any],
        f_struct: PyTree,
        aux_struct: PyTree,
        tags: frozenset[object],
    ) -> NewtonState:
        del options, f_struct, aux_struct, tags
        return NewtonState(*fn(y, args))

    def step(
        self,
        fn: Callable,
        y: Float[Array, "3"],
        args: PyTree,
        options: dict[str, Any],
        state: NewtonState,
        tags: frozenset[object],
    ) -> tuple[Float[Array, "3"], NewtonState, PyTree]:
        del options, tags
        step = solve_3x3(state.jacobian, state.residual)
        length = jnp.sqrt(jnp.sum(step**2))
        # A singular Jacobian gives a step that is not finite, which ends the solve.
        scale = jnp.where(length > self.max_step, self.max_step / length, 1.0)
        new_y = y - jnp.where(jnp.isfinite(length), scale * step, jnp.nan)
        residual, jacobian = fn(new_y, args)
        return new_y, NewtonState(residual, jacobian), jacobian

    def terminate(
        self,
        fn: Callable,
        y: Float[Array, "3"],
        args: PyTree,
        options: dict[str, Any],
        state: NewtonState,
        tags: frozenset[object],
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        del fn, y, args, options, tags
        return stopping_rule(self.norm(state.residual), self.atol, self.divergence)

    def postprocess(
        self,
        fn: Callable,
        y: Float[Array, "3"],
        aux: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: NewtonState,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Float[Array, "3"], PyTree, dict[str, Any]]:
        del fn, args, options, tags, result
        return y, aux, {"residual_norm": self.norm(state.residual)}


def stopping_rule(
    residual: Float[Array, ""], atol: float, divergence: float
) -> tuple[Bool[Array, ""], optx.RESULTS]:
    """Whether to stop, and the result: converged, diverged or not finite."""
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
    # A sum instead of a matrix product: never in reduced precision.
    return (matrix * vector).sum(-1)
