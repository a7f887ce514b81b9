"""Newton's method for maps that know their own Jacobian, in three dimensions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from ..kinematics import solve_3x3
from .broyden import stopping_rule


class NewtonState(eqx.Module):
    """Residual and Jacobian at the current iterate."""

    residual: Float[Array, "3"]
    jacobian: Float[Array, "3 3"]


class ClosedFormNewton(optx.AbstractRootFinder):
    """Newton's method for `fn(y, args) -> (residual, jacobian)` with three unknowns.

    The function returns its Jacobian as its auxiliary output (`has_aux=True`), since on a grid it
    costs the same eight reads as the value; the 3x3 inverse is in closed form. Steps are cut to
    `max_step` metres: at a kink between cells a full step may overshoot.
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
        # Also catches the step of a singular Jacobian, which is not finite: stay put, and stop.
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
