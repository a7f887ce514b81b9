"""Many small solves at once, with the unfinished ones kept together.

Under `vmap` a loop runs every lane until the last one ends, and some starts never converge: all
lanes pay for the slowest. Here lanes are taken block by block. A block is stepped as a whole; when
so many of its lanes have ended that the rest fits a narrower block, the rest is gathered into one.
Shapes are fixed, so it works under `jit`; nothing is scattered, which a compiler does slowly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

# Each narrower block is this share of the first: lanes run out quickly, then slowly.
_NARROWER = (2, 8, 64)
_LEAST_WIDTH = 16
# Lanes of a group that are this many rows apart are not compared: bones of one limb or finger,
# whose starts are the first to meet, stand together.
_REACH = 12


class Solved(NamedTuple):
    """What became of L lanes.

    - `y`: `(L, n)` the last iterate; `residual`: `(L,)` its norm, infinite for lanes that were not
      active.
    - `steps`: `(L,)`.
    """

    y: Float[Array, "L n"]
    residual: Float[Array, " L"]
    steps: Int[Array, " L"]


class _Block(NamedTuple):
    """W lanes on their way. `going` is false for those that have ended."""

    y: Float[Array, "W n"]
    state: PyTree
    args: PyTree
    group: Int[Array, " W"]
    going: Bool[Array, " W"]
    steps: Int[Array, " W"]


def solve_lanes(
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
    """Drive `solver` from every active lane's start.

    `fn(y, args)` is as for `optimistix.root_find(..., has_aux=True)`; the leaves of `args` have a
    leading lane axis. A lane ends by the solver's own `terminate`, or after `max_steps`. `width`
    lanes are stepped together.

    Every `group_size` lanes in a row look for roots of one equation. Where the residual of one has
    fallen below `merge`, others that come this close to it end.
    """
    lanes = start.shape[0]
    width = min(width, lanes)
    widths = [width, *(width // k for k in _NARROWER if width // k >= _LEAST_WIDTH)]
    drive = _Driver(solver, fn, options or (lambda y, a: {}), max_steps, group_size, merge)
    place = jnp.cumsum(active)  # of a lane among the active ones, from 1
    group = jnp.arange(lanes) // group_size

    def block(k: Array, out: Solved) -> Solved:
        rows = _find(place, k * width, width)
        y, own, of = _take((start, args, group), rows)
        solved = drive.begin(y, own, of, rows < lanes, widths)
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

    def begin(
        self, y: Array, args: PyTree, group: Array, active: Array, widths: list[int]
    ) -> Solved:
        """Solve one block from its starts."""

        def init(y: Array, a: PyTree) -> Any:
            return self.solver.init(self.fn, y, a, self.options(y, a), None, None, frozenset())

        state = jax.vmap(init)(y, args)
        steps = jnp.zeros(active.shape, jnp.int32)
        block = _Block(y, state, args, group, active, steps)
        return self.narrow(self.close(block), widths)

    def narrow(self, block: _Block, widths: list[int]) -> Solved:
        """Step until the rest fits the next width; go on with the rest alone."""
        smaller = widths[1] if len(widths) > 1 else 0
        # The lanes of the narrowest blocks are lost ones, which meet no other.
        merging = self.merge > 0 and self.group_size > 1 and len(widths) > 2
        advance = self.advance_and_merge if merging else self.advance
        block = jax.lax.while_loop(lambda b: jnp.sum(b.going) > smaller, advance, block)
        residual = _norm(block.state)
        solved = Solved(block.y, residual, block.steps)
        if not smaller:
            return solved
        place = jnp.cumsum(block.going)
        rest = _take(block, _find(place, 0, smaller))
        rest = rest._replace(going=jnp.arange(smaller) < place[-1])
        after = _take(self.narrow(rest, widths[1:]), place - 1)
        return _where(block.going, after, solved)

    def advance(self, block: _Block) -> _Block:
        """One step of every lane that is going."""

        def step(y: Array, a: PyTree, state: Any) -> tuple[Array, Any]:
            return self.solver.step(self.fn, y, a, {}, state, frozenset())[:2]

        moved = jax.vmap(step)(block.y, block.args, block.state)
        y, state = _where(block.going, moved, (block.y, block.state))
        return self.close(block._replace(y=y, state=state, steps=block.steps + block.going))

    def close(self, block: _Block) -> _Block:
        """End the lanes that are done, by the solver's own rule or the count."""

        def ended(y: Array, a: PyTree, state: Any) -> Array:
            return self.solver.terminate(self.fn, y, a, {}, state, frozenset())[0]

        done = jax.vmap(ended)(block.y, block.args, block.state)
        return block._replace(going=block.going & ~done & (block.steps < self.max_steps))

    def advance_and_merge(self, block: _Block) -> _Block:
        """The same; then lanes end that have come close to a better one of their group."""
        block = self.advance(block)
        near = _near_better(block, min(self.group_size - 1, _REACH), self.merge)
        return block._replace(going=block.going & ~near)


def _near_better(block: _Block, reach: int, radius: float) -> Bool[Array, " W"]:
    """Whether a lane of the same group is this near, is better, and is nearly there.

    Only near a root do two lanes at one place end at one root: far from any, each has its chance.
    """
    size = block.y.shape[0]
    pad = lambda v, fill: jnp.pad(v, (reach, reach), constant_values=fill)  # noqa: E731
    group = pad(block.group, -1)
    # Coordinates apart: the compiler then works on whole rows of lanes.
    axes = [pad(block.y[:, k], jnp.inf) for k in range(block.y.shape[1])]
    error = pad(_norm(block.state), jnp.inf)
    here = slice(reach, reach + size)
    found = jnp.zeros(size, bool)
    for shift in (*range(-reach, 0), *range(1, reach + 1)):
        other = slice(reach + shift, reach + shift + size)
        apart = sum(((v[here] - v[other]) ** 2 for v in axes), jnp.zeros(()))
        better = error[other] <= error[here] if shift < 0 else error[other] < error[here]
        close = (apart < radius**2) & (error[other] < radius)
        found |= (group[here] == group[other]) & close & better
    return found


def _norm(state: Any) -> Float[Array, " W"]:
    return jnp.sqrt(jnp.sum(state.residual**2, axis=-1))


def _find(place: Int[Array, " L"], first: Array | int, count: int) -> Int[Array, " count"]:
    """Rows of the active lanes `first` to `first + count`; beyond the last row where none is."""
    wanted = first + jnp.arange(1, count + 1, dtype=place.dtype)
    return jnp.searchsorted(place, wanted)


def _take(tree: Any, rows: Int[Array, " n"]) -> Any:
    return jax.tree.map(lambda leaf: jnp.take(leaf, rows, axis=0, mode="clip"), tree)


def _where(mask: Bool[Array, " W"], new: Any, old: Any) -> Any:
    def choose(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(-1, *(1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, new, old)
