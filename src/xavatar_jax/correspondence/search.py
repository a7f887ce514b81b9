"""The fast searches: all starts of many points in one batch, then the distinct roots of each."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..fields import AbstractGeometryField, AbstractSkinningField, PosedGrid, skin_with_jacobian
from ..kinematics import inverse_3x3, skin_points, solve_3x3
from .batched import Solved, solve_batched
from .reference import DIVERGENCE
from .root_finders import Broyden, ClosedFormNewton
from .starts import StartTable, pull_back_all

GRID_SOLVER = ClosedFormNewton(atol=1e-5, divergence=DIVERGENCE)
FIELD_SOLVER = Broyden(atol=1e-5, divergence=DIVERGENCE)
# On a guide, a millimetre is enough, since Newton's method on the field follows. A start that ends
# at a fold of the guide may still lead to a root of the field, and two places that are close on the
# guide may be two roots: more places are kept, and starts are not merged.
NEAR_SOLVER = ClosedFormNewton(atol=1e-3, divergence=DIVERGENCE)
NEAR_MORE = 6
# Starts of a point this close to each other, in metres, lead to one root.
MERGE = 2e-4
CHUNK = 8192
"""Points searched together: bounds memory, and a few thousand are as fast as more."""
# Roots closer than this, in metres, are the same: over ten times the search's tolerance.
SAME_ROOT = 5e-4


class Outcome(eqx.Enumeration):
    """Result of the search for one point."""

    found = "at least one root"
    not_finite = "the point is not finite"
    bad_transforms = "a bone transform is not a rotation, one scale and a translation"
    no_start = "no bone starts the search for a point of this part"
    outside = "every start that converged did so outside the region that the field covers"
    diverged = "every start ran away"
    not_converged = "no start converged within the steps allowed"


class Roots(eqx.Module):
    """Distinct roots of P posed points, at most K each.

    - `x_c`: `(P, K, 3)` metres; meaningful where `valid`.
    - `valid`: `(P, K)`; `residual`: `(P, K)` metres, infinite where not valid.
    - `outcome`: `(P,)` an `Outcome`; `more`: `(P,)` whether roots beyond K were dropped.
    - `steps`: total number of solver steps; `lanes`: number of starts.
    """

    x_c: Float[Array, "P K 3"]
    valid: Bool[Array, "P K"]
    residual: Float[Array, "P K"]
    outcome: Outcome
    more: Bool[Array, " P"]
    steps: Int[Array, ""]
    lanes: Int[Array, ""]


_Solve = Callable[..., Solved]
_Covers = Callable[[Array], Array]


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
    """Roots of the tabulated field in one frame, for points with part labels.

    Newton's method with the exact Jacobian of the cell that an iterate is in.

    - `grid`: `pose_grid(tabulate(field, grids), transforms)`; residuals are those of the
      interpolated field.
    - `parts`: the row of `starts` for each point; see `start_table`.
    - `solver`: any root finder of `optimistix`.
    - `keep`: roots per point; `merge`: metres, 0 never merges; `chunk`: points at a time.

    **Raises:** `ValueError` when tracing for wrong shapes. Failures at run time are reported per
    point in `outcome`.
    """

    def residual(x: Array, target: Array) -> tuple[Array, Array]:
        point, jacobian = grid(x)
        return point - target, jacobian

    solve = partial(solve_batched, solver, residual, max_steps=max_steps, width=width, merge=merge)
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
    solver: optx.AbstractRootFinder = FIELD_SOLVER,
    keep: int = 6,
    max_steps: int = 50,
    width: int = 2048,
    merge: float = MERGE,
    chunk: int = CHUNK,
) -> Roots:
    """Roots of any field, for points with part labels.

    Without a `guide`, each start is solved on the field itself, by default by Broyden's method
    from the exact Jacobian at the start, with one query of the field per step. A `guide` is the
    same field tabulated and posed: starts are solved on it to a millimetre, and Newton's method
    takes the few distinct places to the roots of the field. Residuals are then the field's, at a
    handful of queries per point. Other arguments are as for `search_grid`. With a guide, starts
    are not merged, and of `solver` and `max_steps` only `solver.atol` is used.
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

    def residual(x: Array, target: Array) -> tuple[Array, Array | None]:
        if isinstance(solver, ClosedFormNewton):
            posed, jacobian, _ = skin_with_jacobian(field, x, transforms)
            return posed - target, jacobian
        return skin_points(x, field(x), transforms) - target, None

    def options(x: Array, target: Array) -> dict[str, Array]:
        if not isinstance(solver, Broyden):
            return {}
        jacobian = jax.jacfwd(lambda v: residual(v, target)[0])(x)
        return {"inverse_jacobian": inverse_3x3(jacobian)}

    solve = partial(
        solve_batched,
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
    """Move roots of a nearby field to those of this one, by Newton's method to `atol`.

    Roots that do not converge are dropped, and duplicates are removed. Returns at most `keep`
    roots per point (default: as many as were given).
    """
    solver = ClosedFormNewton(atol=atol, divergence=DIVERGENCE)

    def residual(x: Array, target: Array) -> tuple[Array, Array]:
        posed, jacobian, _ = skin_with_jacobian(field, x, transforms)
        return posed - target, jacobian

    points, given = roots.valid.shape
    if not points:
        return _no_roots(x_d, keep or given)
    solved = solve_batched(
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


def move_roots(
    field: AbstractSkinningField,
    guide: PosedGrid | None,
    x_c: Float[Array, "*points 3"],
    x_d: Float[Array, "*points 3"],
    transforms: Float[Array, "J 4 4"],
    *,
    steps: int = 2,
    atol: float = 1e-4,
    max_step: float = 0.02,
) -> tuple[Float[Array, "*points 3"], Bool[Array, "*points"]]:
    """Move roots that were found for an earlier or a nearby field to the roots of this one.

    Takes `steps` Newton steps. Residuals are the field's own, at one query per step and one more
    for the final test. Jacobians come from `guide`, the field tabulated and posed, and are close
    enough for a small number of steps; without a guide they are the field's own. A step longer
    than `max_step` metres would lead to another root and is not taken.

    Returns the moved points and whether each is a root: its residual on the field is below `atol`
    metres, and the field covers it. Not differentiable; see `implicit_root`.
    """
    field, guide, x_d, transforms = jax.lax.stop_gradient((field, guide, x_d, transforms))

    def residual(x: Array, target: Array) -> Array:
        return skin_points(x, field(x), transforms) - target

    def move(x: Array, target: Array) -> tuple[Array, Array]:
        for _ in range(steps):
            if guide is None:
                posed, jacobian, _ = skin_with_jacobian(field, x, transforms)
                off = posed - target
            else:
                off, jacobian = residual(x, target), guide(x)[1]
            step = solve_3x3(jacobian, off)
            # Also false for a step that is not finite.
            x = jnp.where(jnp.sum(step**2) < max_step**2, x - step, x)
        # Also false for a residual that is not finite.
        return x, (jnp.sum(residual(x, target) ** 2) < atol**2) & field.covers(x)

    batch = x_c.shape[:-1]
    moved, valid = jax.vmap(move)(jax.lax.stop_gradient(x_c).reshape(-1, 3), x_d.reshape(-1, 3))
    return moved.reshape(*batch, 3), valid.reshape(batch)


def best_root(
    geometry: AbstractGeometryField,
    x_c: Float[Array, "P K 3"],
    valid: Bool[Array, "P K"],
    condition: PyTree[Array],
) -> tuple[Float[Array, "P 3"], Bool[Array, " P"]]:
    """Of the roots of each point the one with the largest level, and whether there is one.

    Which root it is has no derivative. Source: X-Avatar, section 3.3.
    """
    geometry, x_c, condition = jax.lax.stop_gradient((geometry, x_c, condition))
    # Roots one after another: memory is that of one root per point.
    level = jax.lax.map(
        lambda x: jax.vmap(lambda x: geometry(x, condition).level)(x), jnp.swapaxes(x_c, 0, 1)
    ).T
    best = jnp.argmax(jnp.where(valid, level, -jnp.inf), axis=-1)
    chosen = jnp.take_along_axis(x_c, best[:, None, None], axis=1)[:, 0]
    found = jnp.any(valid, axis=-1)
    # A point without a root gets the origin: finite, and masked.
    return jnp.where(found[:, None], chosen, 0.0), found


def _search(
    solve: _Solve,
    covers: _Covers,
    solver: optx.AbstractRootFinder,
    x_d: Array,
    parts: Array,
    transforms: Array,
    starts: StartTable,
    keep: int,
    chunk: int,
) -> Roots:
    """Search in chunks of points."""
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
        limit = getattr(solver, "divergence", DIVERGENCE)
        outcome = outcomes(x, rigid, started, residual, converged, valid, limit)
        steps, lanes = jnp.sum(solved.steps), jnp.sum(usable)
        return Roots(x_c, found, error, outcome, more, steps, lanes)

    points = x_d.shape[0]
    if points <= chunk:
        return one_chunk((x_d, parts)) if points else _no_roots(x_d, keep)
    fill = -points % chunk
    # Padding has no part, so it has no starts.
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


def distinct_roots(
    x_c: Float[Array, "P I 3"],
    residual: Float[Array, "P I"],
    valid: Bool[Array, "P I"],
    keep: int,
) -> tuple[Float[Array, "P K 3"], Float[Array, "P K"], Bool[Array, "P K"], Bool[Array, " P"]]:
    """The first `keep` distinct valid candidates: roots, residuals, valid, whether more exist."""
    left = valid
    rows = []
    for _ in range(min(keep, valid.shape[1])):
        first = jnp.argmax(left, axis=1)[:, None]
        there = jnp.take_along_axis(left, first, axis=1)[:, 0]
        root = jnp.take_along_axis(x_c, first[..., None], axis=1)[:, 0]
        error = jnp.take_along_axis(residual, first, axis=1)[:, 0]
        # One coordinate at a time vectorises over points.
        apart = sum(
            ((x_c[..., k] - root[:, None, k]) ** 2 for k in range(3)), jnp.zeros((), x_c.dtype)
        )
        left = left & ~(apart < SAME_ROOT**2)
        rows.append((root, jnp.where(there, error, jnp.inf), there))
    roots, errors, found = (jnp.stack(column, axis=1) for column in zip(*rows, strict=True))
    return roots, errors, found, jnp.any(left, axis=1)


def outcomes(
    x_d: Float[Array, "P 3"],
    rigid: Bool[Array, ""],
    started: Bool[Array, "P I"],
    residual: Float[Array, "P I"],
    converged: Bool[Array, "P I"],
    valid: Bool[Array, "P I"],
    divergence: float,
) -> Outcome:
    """The outcome of each point, from the results of its starts."""

    def of_point(x: Array, started: Array, residual: Array, converged: Array, valid: Array):
        ran_away = jnp.all(~started | ~(residual < divergence))
        causes = (  # the first that applies
            (~jnp.all(jnp.isfinite(x)), Outcome.not_finite),
            (~rigid, Outcome.bad_transforms),
            (~jnp.any(started), Outcome.no_start),
            (jnp.any(valid), Outcome.found),
            (jnp.any(converged), Outcome.outside),
            (ran_away, Outcome.diverged),
        )
        answer = Outcome.not_converged
        for holds, cause in reversed(causes):
            answer = Outcome.where(holds, cause, answer)
        return answer

    return jax.vmap(of_point)(x_d, started, residual, converged, valid)
