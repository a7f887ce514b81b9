"""The fast search: all starts of many points as lanes, then a few distinct roots a point."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..fields import AbstractSkinningField, PosedGrid, skin_with_jacobian
from ..kinematics import inverse_3x3, skin_points
from .broyden import Broyden
from .lanes import Solved, solve_lanes
from .newton import ClosedFormNewton
from .plain import DIVERGENCE
from .roots import Outcome, Roots, distinct_roots, outcomes
from .starts import StartTable, pull_back_all

GRID_SOLVER = ClosedFormNewton(atol=1e-5, divergence=DIVERGENCE)
FIELD_SOLVER = Broyden(atol=1e-5, divergence=DIVERGENCE)
# What is searched on a guide is moved on afterwards: near is enough, and what ends at the edge of a
# fold of one field may have a root in the other. Such places repeat, so more of them are kept, and
# none is merged: two that are near on the guide may be two roots of the field.
NEAR_SOLVER = ClosedFormNewton(atol=1e-3, divergence=DIVERGENCE)
NEAR_MORE = 6
# Starts of a point that have come this close, in metres, are on their way to one root.
MERGE = 2e-4
# Points searched at a time: bounds memory, and costs nothing above a few thousand.
CHUNK = 8192

Solve = Callable[..., Solved]
Covers = Callable[[Array], Array]


@partial(jax.jit, static_argnames=("solver", "keep", "max_steps", "width", "merge", "chunk"))
def search_grid(
    grid: PosedGrid,
    x_d: Float[Array, "P 3"],
    parts: Int[Array, " P"],
    transforms: Float[Array, "J 4 4"],
    starts: StartTable,
    *,
    solver: optx.AbstractRootFinder = GRID_SOLVER,
    keep: int = 6,
    max_steps: int = 15,
    width: int = 8192,
    merge: float = MERGE,
    chunk: int = CHUNK,
) -> Roots:
    """Roots of the tabulated field of one frame, for points with part labels.

    Newton's method with the exact Jacobian of the cell that an iterate lies in.

    - `grid`: `pose_grid(tabulate(field, grids), transforms)`; residuals are those of the
      interpolated field.
    - `parts`: each point's row of `starts`, which `start_table` gives.
    - `keep`: roots kept a point; `merge`: metres, 0 for never; `chunk`: points at a time.

    **Raises:** `ValueError` when tracing for a wrong shape. What a point met at run time is its
    `outcome`.
    """

    def residual(x: Array, target: Array) -> tuple[Array, Array]:
        point, jacobian = grid(x)
        return point - target, jacobian

    solve = partial(solve_lanes, solver, residual, max_steps=max_steps, width=width, merge=merge)
    return _search(solve, grid.grids.covers, solver, x_d, parts, transforms, starts, keep, chunk)


@eqx.filter_jit
def search_field(
    field: AbstractSkinningField,
    x_d: Float[Array, "P 3"],
    parts: Int[Array, " P"],
    transforms: Float[Array, "J 4 4"],
    starts: StartTable,
    *,
    guide: PosedGrid | None = None,
    solver: Broyden = FIELD_SOLVER,
    keep: int = 6,
    max_steps: int = 50,
    width: int = 2048,
    merge: float = MERGE,
    chunk: int = CHUNK,
) -> Roots:
    """Roots of any field, for points with part labels.

    Without a `guide`, by Broyden's method from the exact Jacobian at each start, one query of the
    field a step. With a `guide`, the same field tabulated and posed, the search runs on that to a
    millimetre, and the few distinct places found are moved to the field's own roots by Newton's
    method: the residuals are the field's, at a handful of queries a point. Other arguments are as
    for `search_grid`; with a guide, starts are not merged, and of `solver` and `max_steps` the
    tolerance alone is used.
    """
    if guide is not None:
        near = search_grid(
            guide,
            x_d,
            parts,
            transforms,
            starts,
            solver=NEAR_SOLVER,
            keep=keep + NEAR_MORE,
            merge=0.0,
            chunk=chunk,
        )
        return polish(field, near, x_d, transforms, keep=keep, atol=solver.atol, width=width)

    def residual(x: Array, target: Array) -> tuple[Array, None]:
        return skin_points(x, field(x), transforms) - target, None

    def options(x: Array, target: Array) -> dict[str, Array]:
        jacobian = jax.jacfwd(lambda v: residual(v, target)[0])(x)
        return {"inverse_jacobian": inverse_3x3(jacobian)}

    solve = partial(
        solve_lanes,
        solver,
        residual,
        options=options,
        max_steps=max_steps,
        width=width,
        merge=merge,
    )
    covers = jax.vmap(field.covers)
    return _search(solve, covers, solver, x_d, parts, transforms, starts, keep, chunk)


def polish(
    field: AbstractSkinningField,
    roots: Roots,
    x_d: Float[Array, "P 3"],
    transforms: Float[Array, "J 4 4"],
    *,
    keep: int | None = None,
    atol: float = 1e-5,
    max_steps: int = 8,
    width: int = 2048,
) -> Roots:
    """Roots of a nearby field moved to those of this one, by Newton's method.

    Those that do not get there are dropped, and two that become one count once. At most `keep`
    are returned a point (default: as many as were given).
    """
    solver = ClosedFormNewton(atol=atol, divergence=DIVERGENCE)

    def residual(x: Array, target: Array) -> tuple[Array, Array]:
        posed, jacobian, _ = skin_with_jacobian(field, x, transforms)
        return posed - target, jacobian

    points, given = roots.valid.shape
    if not points:
        return _no_roots(x_d, keep or given)
    solved = solve_lanes(
        solver,
        residual,
        roots.x_c.reshape(-1, 3),
        jnp.repeat(x_d, given, axis=0),
        roots.valid.reshape(-1),
        max_steps=max_steps,
        width=width,
    )
    valid = (solved.residual < atol) & jax.vmap(field.covers)(solved.y)
    shaped = (points, given)
    x_c, error, valid, more = distinct_roots(
        solved.y.reshape(points, given, 3),
        solved.residual.reshape(shaped),
        valid.reshape(shaped),
        keep or given,
    )
    lost = (roots.outcome == Outcome.found) & ~jnp.any(valid, axis=1)
    where = jax.vmap(lambda gone, cause: Outcome.where(gone, Outcome.not_converged, cause))
    outcome = where(lost, roots.outcome)
    steps = roots.steps + jnp.sum(solved.steps)
    return Roots(x_c, valid, error, outcome, roots.more | more, steps, roots.lanes)


def _search(
    solve: Solve,
    covers: Covers,
    solver: Any,
    x_d: Array,
    parts: Array,
    transforms: Array,
    starts: StartTable,
    keep: int,
    chunk: int,
) -> Roots:
    """Search in chunks of points; `solve` drives the lanes that it is given."""
    _check_shapes(x_d, parts, transforms, starts)
    rigid = jnp.all(_rigid_up_to_scale(transforms))

    def one_chunk(chunk: tuple[Array, Array]) -> Roots:
        x, part = chunk
        known = (part >= 0) & (part < starts.index.shape[0])
        part = jnp.where(known, part, 0)
        started = starts.mask[part] & known[:, None]
        usable = started & rigid & jnp.all(jnp.isfinite(x), axis=-1, keepdims=True)
        pulled = pull_back_all(x, transforms, starts)
        start = jnp.take_along_axis(pulled, starts.index[part][..., None], axis=1)
        target = jnp.repeat(x, starts.width, axis=0)
        solved = solve(start.reshape(-1, 3), target, usable.reshape(-1), group_size=starts.width)
        converged = solved.residual < solver.atol
        valid = converged & covers(solved.y)
        residual, converged, valid = (
            v.reshape(started.shape) for v in (solved.residual, converged, valid)
        )
        x_c, error, found, more = distinct_roots(
            solved.y.reshape(*started.shape, 3), residual, valid, keep
        )
        outcome = outcomes(x, rigid, started, residual, converged, valid, solver.divergence)
        steps, lanes = jnp.sum(solved.steps), jnp.sum(usable)
        return Roots(x_c, found, error, outcome, more, steps, lanes)

    points = x_d.shape[0]
    if points <= chunk:
        return one_chunk((x_d, parts)) if points else _no_roots(x_d, keep)
    fill = -points % chunk
    # Padding has no part, so it starts nowhere.
    padded = jnp.pad(x_d, ((0, fill), (0, 0))), jnp.pad(parts, (0, fill), constant_values=-1)
    rows = jax.lax.map(
        one_chunk, jax.tree.map(lambda v: v.reshape(-1, chunk, *v.shape[1:]), padded)
    )
    steps, lanes = jnp.sum(rows.steps), jnp.sum(rows.lanes)
    flat = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:])[:points] if v.ndim > 1 else v, rows)
    return eqx.tree_at(lambda r: (r.steps, r.lanes), flat, (steps, lanes))


def _no_roots(x_d: Array, keep: int) -> Roots:
    none = jnp.zeros((0, keep), bool)
    zero = jnp.zeros((), jnp.int32)
    outcome = jax.vmap(lambda _: Outcome.no_start)(x_d)
    return Roots(
        jnp.zeros((0, keep, 3), x_d.dtype),
        none,
        jnp.zeros((0, keep), x_d.dtype),
        outcome,
        none[:, 0],
        zero,
        zero,
    )


def _rigid_up_to_scale(transforms: Float[Array, "J 4 4"]) -> Bool[Array, " J"]:
    linear = transforms[:, :3, :3]
    gram = jnp.sum(linear[:, :, :, None] * linear[:, :, None, :], axis=1)
    scale_sq = jnp.trace(gram, axis1=1, axis2=2) / 3
    off = jnp.abs(gram - scale_sq[:, None, None] * jnp.eye(3, dtype=linear.dtype)).max((1, 2))
    return (off < 1e-3 * scale_sq) & jnp.all(jnp.isfinite(transforms), axis=(1, 2))


def _check_shapes(x_d: Any, parts: Any, transforms: Any, starts: StartTable) -> None:
    for name, value, expected in (
        ("x_d", x_d, (None, 3)),
        ("parts", parts, (x_d.shape[0],)),
        ("transforms", transforms, (len(starts.parents), 4, 4)),
    ):
        shape = jnp.shape(value)
        fits = len(shape) == len(expected) and all(
            e is None or s == e for s, e in zip(shape, expected, strict=True)
        )
        if not fits:
            wanted = tuple("any" if e is None else e for e in expected)
            raise ValueError(f"{name} has shape {shape}, expected {wanted}")
