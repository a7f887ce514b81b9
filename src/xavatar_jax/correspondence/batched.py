"""Many small solves at once.

Under `vmap` a loop runs every lane until the last one ends, and some starts never converge. Here
lanes are solved block by block: all lanes of a block are stepped together, and when enough of them
have ended, the rest is gathered into a narrower block. Shapes are fixed, so it works under `jit`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from .root_finders import AbstractRootState

# Widths of the narrower blocks, as fractions of the first: most lanes end early, a few late.
_NARROWER = (2, 8, 64)
_LEAST_WIDTH = 16
# Lanes of a group are compared up to this many rows apart: starts that meet first, those of one
# limb or finger, are next to each other.
_REACH = 12


class Solved(NamedTuple):
    """Results of L lanes.

    - `y`: `(L, n)` the last iterate; `residual`: `(L,)` its norm, infinite for inactive lanes.
    - `steps`: `(L,)`.
    """

    y: Float[Array, "L n"]
    residual: Float[Array, " L"]
    steps: Int[Array, " L"]


class _Block(NamedTuple):
    """W lanes in progress; `going` is false for those that have ended."""

    y: Float[Array, "W n"]
    state: PyTree
    error: Float[Array, " W"]
    args: PyTree
    group: Int[Array, " W"]
    going: Bool[Array, " W"]
    steps: Int[Array, " W"]


def solve_batched(
    solver: optx.AbstractRootFinder,
    fn: Callable[[Array, PyTree], tuple[Array, Any]],
    start: Float[Array, "L n"],
    args: PyTree,
    active: Bool[Array, " L"],
    *,
    options: Callable[[Array, PyTree], dict[str, Any]] | None = None,
    max_steps: int = 50,
    width: int = 4096,
    group_size: int = 1,
    merge: float = 0.0,
) -> Solved:
    """Run any root finder from the start of every active lane.

    `fn(y, args)` is as for `optimistix.root_find(..., has_aux=True)`; the leaves of `args` have a
    leading lane axis. A lane ends by the solver's own `terminate` or after `max_steps`. `width`
    lanes are stepped together. `options(y, args)` gives the solver's options at the start.

    Every `group_size` consecutive lanes solve one equation from different starts. Once the
    residual of one is below `merge`, the others within that distance of it end.
    """
    lanes = start.shape[0]
    width = min(width, lanes)
    widths = [width, *(width // k for k in _NARROWER if width // k >= _LEAST_WIDTH)]
    driver = _Driver(solver, fn, options or (lambda y, a: {}), max_steps, group_size, merge)
    place = jnp.cumsum(active)  # the number of each active lane, from 1
    group = jnp.arange(lanes) // group_size

    def block(k: Array, out: Solved) -> Solved:
        rows = _find(place, k * width, width)
        y, own, of = _take((start, args, group), rows)
        solved = driver.solve(y, own, of, rows < lanes, widths)
        return jax.tree.map(
            lambda all_, new: jax.lax.dynamic_update_slice_in_dim(all_, new, k * width, 0),
            out,
            solved,
        )

    size = -(-lanes // width) * width
    out = Solved(
        jnp.zeros((size, *start.shape[1:]), start.dtype),
        jnp.full(size, jnp.inf, start.dtype),
        jnp.zeros(size, jnp.int32),
    )
    out = jax.lax.fori_loop(0, -(-place[-1] // width), block, out)
    y, residual, steps = _take(out, place - 1)
    return Solved(y, jnp.where(active, residual, jnp.inf), jnp.where(active, steps, 0))


class _Driver(NamedTuple):
    solver: optx.AbstractRootFinder
    fn: Callable[[Array, PyTree], tuple[Array, Any]]
    options: Callable[[Array, PyTree], dict[str, Any]]
    max_steps: int
    group_size: int
    merge: float

    def solve(
        self, y: Array, args: PyTree, group: Array, active: Array, widths: list[int]
    ) -> Solved:
        """Solve one block from its starts."""

        def init(y: Array, a: PyTree) -> Any:
            structs = jax.eval_shape(self.fn, y, a)
            return self.solver.init(self.fn, y, a, self.options(y, a), *structs, frozenset())  # pyright: ignore[reportCallIssue]

        # What is no array in a solver's state is the same in all lanes and steps.
        state, static = eqx.partition(eqx.filter_vmap(init)(y, args), eqx.is_array)
        steps = jnp.zeros(active.shape, jnp.int32)
        error = jnp.zeros(active.shape, y.dtype)
        block = _Block(y, state, error, args, group, active, steps)
        return self.narrow(self.close(block, static), static, widths)

    def narrow(self, block: _Block, static: Any, widths: list[int]) -> Solved:
        """Step until the unfinished lanes fit the next width; continue with those alone."""
        smaller = widths[1] if len(widths) > 1 else 0
        # The last lanes in the narrowest blocks rarely meet others.
        merging = self.merge > 0 and self.group_size > 1 and len(widths) > 2

        def advance(block: _Block) -> _Block:
            block = self.advance(block, static)
            if merging:
                near = _near_better(block, min(self.group_size - 1, _REACH), self.merge)
                block = block._replace(going=block.going & ~near)
            return block

        block = jax.lax.while_loop(lambda b: jnp.sum(b.going) > smaller, advance, block)
        solved = Solved(block.y, block.error, block.steps)
        if not smaller:
            return solved
        place = jnp.cumsum(block.going)
        rest = _take(block, _find(place, 0, smaller))
        rest = rest._replace(going=jnp.arange(smaller) < place[-1])
        after = _take(self.narrow(rest, static, widths[1:]), place - 1)
        return _where(block.going, after, solved)

    def advance(self, block: _Block, static: Any) -> _Block:
        """Step every unfinished lane."""

        def step(y: Array, a: PyTree, state: Any) -> tuple[Array, Any]:
            state = eqx.combine(state, static)
            y, state, _ = self.solver.step(self.fn, y, a, {}, state, frozenset())
            return y, eqx.filter(state, eqx.is_array)

        moved = jax.vmap(step)(block.y, block.args, block.state)
        y, state = _where(block.going, moved, (block.y, block.state))
        block = block._replace(y=y, state=state, steps=block.steps + block.going)
        return self.close(block, static)

    def close(self, block: _Block, static: Any) -> _Block:
        """Measure the residuals; end the lanes that are done or out of steps."""

        def look(y: Array, a: PyTree, state: Any) -> tuple[Array, Array]:
            state = eqx.combine(state, static)
            done = self.solver.terminate(self.fn, y, a, {}, state, frozenset())[0]
            known = isinstance(state, AbstractRootState)
            residual = state.residual if known else self.fn(y, a)[0]
            return jnp.sqrt(jnp.sum(residual**2)), done

        error, done = jax.vmap(look)(block.y, block.args, block.state)
        going = block.going & ~done & (block.steps < self.max_steps)
        return block._replace(error=error, going=going)


def _near_better(block: _Block, reach: int, radius: float) -> Bool[Array, " W"]:
    """Whether a better lane of the same group is within `radius`, and almost at its root.

    Two lanes at one place lead to the same root only close to it; far from any root both go on.
    """
    size = block.y.shape[0]
    pad = lambda v, fill: jnp.pad(v, (reach, reach), constant_values=fill)  # noqa: E731
    group = pad(block.group, -1)
    # One coordinate at a time vectorises over lanes.
    axes = [pad(block.y[:, k], jnp.inf) for k in range(block.y.shape[1])]
    error = pad(block.error, jnp.inf)
    here = slice(reach, reach + size)
    found = jnp.zeros(size, bool)
    for shift in (*range(-reach, 0), *range(1, reach + 1)):
        other = slice(reach + shift, reach + shift + size)
        apart = sum(((v[here] - v[other]) ** 2 for v in axes), jnp.zeros((), error.dtype))
        better = error[other] <= error[here] if shift < 0 else error[other] < error[here]
        close = (apart < radius**2) & (error[other] < radius)
        found |= (group[here] == group[other]) & close & better
    return found


def _find(place: Int[Array, " L"], first: Array | int, count: int) -> Int[Array, " count"]:
    """Rows of the active lanes `first` to `first + count`; past the end where there are fewer."""
    wanted = first + jnp.arange(1, count + 1, dtype=place.dtype)
    return jnp.searchsorted(place, wanted)


def _take(tree: Any, rows: Int[Array, " n"]) -> Any:
    return jax.tree.map(lambda leaf: jnp.take(leaf, rows, axis=0, mode="clip"), tree)


def _where(mask: Bool[Array, " W"], new: Any, old: Any) -> Any:
    def choose(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(-1, *(1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, new, old)
