"""Many small solves at once, with the unfinished ones gathered.

Under `vmap` a loop runs every lane until the last one ends, and some starts never converge: all
lanes pay for the slowest. Here a fixed number of unfinished lanes is gathered, stepped and
scattered back, until none is left; as lanes run out, fewer are gathered at a time. Shapes are
fixed, so it works under `jit`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree


def solve_lanes(
    solver: optx.AbstractRootFinder,
    fn: Callable[[Array, PyTree], tuple[Array, Any]],
    start: Float[Array, "L 3"],
    args: PyTree,
    active: Bool[Array, " L"],
    *,
    options: Callable[[Array, PyTree], dict[str, Any]] | None = None,
    max_steps: int = 50,
    width: int = 4096,
) -> tuple[Float[Array, "L 3"], Float[Array, " L"], Int[Array, " L"]]:
    """Drive `solver` from every active lane's start; returns roots, residual norms and steps.

    `fn(y, args)` is as for `optimistix.root_find(..., has_aux=True)`; the leaves of `args` have a
    leading lane axis. `width` lanes are stepped together. Lanes that were not active have an
    infinite residual. A lane ends by the solver's own `terminate`, or after `max_steps`.
    """
    lanes = start.shape[0]
    width = min(width, lanes)
    tags: frozenset[object] = frozenset()
    make_options = options or (lambda y, a: {})

    def init(y: Array, a: PyTree) -> Any:
        return solver.init(fn, y, a, make_options(y, a), None, None, tags)

    def step(y: Array, a: PyTree, state: Any) -> tuple[Array, Any]:
        y, state, _ = solver.step(fn, y, a, {}, state, tags)
        return y, state

    def ended(y: Array, a: PyTree, state: Any) -> Array:
        return solver.terminate(fn, y, a, {}, state, tags)[0]

    # One lane more, a place for the padding of a gather to write to.
    pad = lambda leaf: jnp.concatenate([leaf, leaf[:1]])  # noqa: E731
    start, args = pad(start), jax.tree.map(pad, args)
    struct = jax.eval_shape(init, start[0], jax.tree.map(lambda leaf: leaf[0], args))
    states = jax.tree.map(lambda s: jnp.zeros((lanes + 1, *s.shape), s.dtype), struct)
    fresh = jnp.concatenate([active, jnp.zeros(1, bool)])

    def gather(mask: Array, size: int) -> Array:
        return jnp.nonzero(mask, size=size, fill_value=lanes)[0]

    def begin(carry: tuple) -> tuple:
        y, states, todo, fresh, steps = carry
        rows = gather(fresh, width)
        own = jax.tree.map(lambda leaf: leaf[rows], args)
        state = jax.vmap(init)(y[rows], own)
        going = ~jax.vmap(ended)(y[rows], own, state)
        states = jax.tree.map(lambda all_, new: all_.at[rows].set(new), states, state)
        todo = todo.at[rows].set(going).at[lanes].set(False)
        return y, states, todo, fresh.at[rows].set(False), steps

    def advance(size: int, carry: tuple) -> tuple:
        y, states, todo, fresh, steps = carry
        rows = gather(todo, size)
        own = jax.tree.map(lambda leaf: leaf[rows], args)
        state = jax.tree.map(lambda leaf: leaf[rows], states)
        moved, state = jax.vmap(step)(y[rows], own, state)
        count = steps[rows] + 1
        going = ~jax.vmap(ended)(moved, own, state) & (count < max_steps)
        states = jax.tree.map(lambda all_, new: all_.at[rows].set(new), states, state)
        todo = todo.at[rows].set(going).at[lanes].set(False)
        return y.at[rows].set(moved), states, todo, fresh, steps.at[rows].set(count)

    carry = (start, states, jnp.zeros(lanes + 1, bool), fresh, jnp.zeros(lanes + 1, jnp.int32))
    carry = jax.lax.while_loop(lambda c: jnp.any(c[3]), begin, carry)
    # The last lanes are those that never converge: a wide gather would be mostly padding.
    sizes = [width, *(size for size in (width // 8, width // 64) if size >= 8)]
    for size, smaller in zip(sizes, [*sizes[1:], 0], strict=True):
        enough = partial(lambda least, c: jnp.sum(c[2]) > least, smaller)
        carry = jax.lax.while_loop(enough, partial(advance, size), carry)
    y, states, _, _, steps = carry
    residual = jnp.sqrt(jnp.sum(states.residual**2, axis=-1))
    residual = jnp.where(active, residual[:lanes], jnp.inf)
    return y[:lanes], residual, steps[:lanes]
