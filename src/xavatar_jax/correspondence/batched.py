"""The fast search: all starts of many points as lanes, then a few distinct roots a point."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..fields import AbstractSkinningField, PosedGrid
from ..kinematics import inverse_3x3, skin_points
from .broyden import Broyden
from .lanes import solve_lanes
from .newton import ClosedFormNewton
from .plain import DIVERGENCE, pull_back

GRID_SOLVER = ClosedFormNewton(atol=1e-5, divergence=DIVERGENCE)
FIELD_SOLVER = Broyden(atol=1e-5, divergence=DIVERGENCE)
# Roots closer than this are one root found twice: ten times the search's tolerance and more.
SAME_ROOT = 5e-4


class Roots(eqx.Module):
    """Distinct roots of many posed points.

    - `x_c`: `(P, K, 3)` metres; meaningful where `valid`.
    - `valid`: `(P, K)`.
    - `residual`: `(P, K)` metres, infinite where not valid.
    - `overflow`: `(P,)` distinct roots that were found beyond K.
    - `steps`: solver steps in all, and `lanes` the starts that took them.
    """

    x_c: Float[Array, "P K 3"]
    valid: Bool[Array, "P K"]
    residual: Float[Array, "P K"]
    overflow: Int[Array, " P"]
    steps: Int[Array, ""]
    lanes: Int[Array, ""]


@partial(jax.jit, static_argnames=("solver", "keep", "max_steps", "width"))
def search_grid(
    grid: PosedGrid,
    x_d: Float[Array, "P 3"],
    parts: Int[Array, " P"],
    transforms: Float[Array, "J 4 4"],
    bones: Int[Array, "parts I"],
    mask: Bool[Array, "parts I"],
    *,
    solver: optx.AbstractRootFinder = GRID_SOLVER,
    keep: int = 3,
    max_steps: int = 15,
    width: int = 4096,
) -> Roots:
    """Roots of the tabulated field of one frame, for points with part labels.

    `bones` and `mask` are `start_table`'s. Residuals are those of the interpolated field.
    """

    def residual(x: Array, target: Array) -> tuple[Array, Array]:
        point, jacobian = grid(x)
        return point - target, jacobian

    start, target, active = _lanes(x_d, parts, transforms, bones, mask)
    x_c, error, steps = solve_lanes(
        solver, residual, start, target, active, max_steps=max_steps, width=width
    )
    valid = (error < solver.atol) & grid.grids.covers(x_c)
    return _distinct(x_c, error, valid, steps, active, x_d.shape[0], keep)


@eqx.filter_jit
def search_field(
    field: AbstractSkinningField,
    x_d: Float[Array, "P 3"],
    parts: Int[Array, " P"],
    transforms: Float[Array, "J 4 4"],
    bones: Int[Array, "parts I"],
    mask: Bool[Array, "parts I"],
    *,
    solver: Broyden = FIELD_SOLVER,
    keep: int = 3,
    max_steps: int = 50,
    width: int = 2048,
) -> Roots:
    """The same on any field, by Broyden's method from the exact Jacobian at each start."""

    def residual(x: Array, target: Array) -> tuple[Array, None]:
        return skin_points(x, field(x), transforms) - target, None

    def options(x: Array, target: Array) -> dict[str, Array]:
        jacobian = jax.jacfwd(lambda v: residual(v, target)[0])(x)
        return {"inverse_jacobian": inverse_3x3(jacobian)}

    start, target, active = _lanes(x_d, parts, transforms, bones, mask)
    x_c, error, steps = solve_lanes(
        solver,
        residual,
        start,
        target,
        active,
        options=options,
        max_steps=max_steps,
        width=width,
    )
    valid = (error < solver.atol) & jax.vmap(field.covers)(x_c)
    return _distinct(x_c, error, valid, steps, active, x_d.shape[0], keep)


def _lanes(
    x_d: Array, parts: Array, transforms: Array, bones: Array, mask: Array
) -> tuple[Array, Array, Array]:
    chosen = bones[parts]  # (P, I)
    start = jax.vmap(lambda x, b: pull_back(x, transforms[b]))(x_d, chosen)
    width = chosen.shape[1]
    target = jnp.repeat(x_d, width, axis=0)
    active = mask[parts] & jnp.all(jnp.isfinite(x_d), axis=-1, keepdims=True)
    return start.reshape(-1, 3), target, active.reshape(-1)


def _distinct(
    x_c: Array, error: Array, valid: Array, steps: Array, active: Array, points: int, keep: int
) -> Roots:
    x_c, error, valid = (v.reshape(points, -1, *v.shape[1:]) for v in (x_c, error, valid))
    starts = valid.shape[1]
    apart = jnp.sum((x_c[:, :, None] - x_c[:, None, :]) ** 2, axis=-1)
    earlier = jnp.tril(jnp.ones((starts, starts), bool), -1)
    repeated = jnp.any((apart < SAME_ROOT**2) & earlier & valid[:, None, :], axis=-1)
    first = valid & ~repeated
    order = jnp.argsort(~first, axis=1, stable=True)[:, :keep]
    take = partial(jnp.take_along_axis, axis=1)
    chosen = take(first, order)
    return Roots(
        x_c=jnp.take_along_axis(x_c, order[..., None], axis=1),
        valid=chosen,
        residual=jnp.where(chosen, take(error, order), jnp.inf),
        overflow=jnp.maximum(jnp.sum(first, axis=1) - keep, 0),
        steps=jnp.sum(jnp.where(active, steps, 0)),
        lanes=jnp.sum(active),
    )
