"""Points drawn anew while training goes on: made ahead in one thread, taken at fixed steps."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..body import BodyModel
from ..fields import AbstractSkinningField
from ..frames import Frames
from .config import FitConfig
from .pool import (
    FramePool,
    draw_points,
    polish_roots,
    pool_of,
    rows_in_turn,
    search_roots,
    tabulate_for_search,
)


class Redraw:
    """New points for a few frames of a pool at a time, one round after another.

    Round r = 1, 2, ... is due after step r times `config.redraw_every`, and has the next
    `config.redraw_frames` of the frames learned from. Its points are a function of seed, frame
    and round, and their roots are searched on the fields at the start, so that nothing depends on
    when the thread did its work; `take` waits for it.

    - `frames`: those learned from, in the order of the pool; `start`: the skinning field that the
      pool's own roots were searched on.
    """

    def __init__(
        self,
        body: BodyModel,
        frames: Frames,
        betas: Any,
        config: FitConfig,
        start: AbstractSkinningField,
    ):
        self.body, self.frames, self.config = body, frames, config
        self._table = None
        if config.search.cached:
            self._table = tabulate_for_search(body, betas, start, config)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="redraw")
        self._waiting: tuple[int, Future[FramePool]] | None = None

    def round_at(self, step: int) -> int:
        """The round that is due after this step, or 0."""
        number, rest = divmod(step, self.config.redraw_every)
        return 0 if rest else number

    def rows(self, number: int) -> Int[np.ndarray, " r"]:
        """Which frames of the pool a round replaces."""
        return rows_in_turn(number, self.config.redraw_frames, len(self.frames))

    def begin(self, step: int) -> None:
        """Let the thread make the first round that is due after this step."""
        number = step // self.config.redraw_every + 1
        if number * self.config.redraw_every < self.config.steps:
            self._waiting = number, self._thread.submit(self._make, number)

    def take(self, number: int, skinning: AbstractSkinningField) -> FramePool:
        """A round's points, with roots polished on the field as it is now.

        **Raises:** what reading a frame raises.
        """
        assert self._waiting is not None
        assert self._waiting[0] == number
        new = self._waiting[1].result()
        if self._table is not None:
            new = polish_roots(skinning, self._table, new, steps=2)
        return new

    def close(self) -> None:
        """End the thread, after the round that it is at."""
        self._thread.shutdown(cancel_futures=True)

    def _make(self, number: int) -> FramePool:
        rows = self.rows(number)
        frames = self.frames[rows]
        drawn = [
            draw_points(self.body, frames[k], self.config, place=int(row), round_number=number)
            for k, row in enumerate(rows)
        ]
        new = pool_of(self.body, drawn, frames.params)
        if self._table is None:
            return new
        return search_roots(self.body, self._table, new, self.config)


def put_rows(pool: FramePool, new: FramePool, rows: Int[np.ndarray, " r"]) -> FramePool:
    """Points and roots of some frames replaced.

    The pool has room for so many points of several roots: of a frame with more, those with the
    fewest keep their first one alone.
    """
    return _put(pool, _as_wide_as(pool, new), jnp.asarray(rows))


def _as_wide_as(pool: FramePool, new: FramePool) -> FramePool:
    width = pool.others.shape[1]
    short = max(width - new.others.shape[1], 0)
    room = ((0, 0), (0, short), (0, 0))
    return eqx.tree_at(
        lambda p: (p.others, p.others_valid),
        new,
        (
            jnp.pad(new.others, (*room, (0, 0)))[:, :width],
            jnp.pad(new.others_valid, room)[:, :width],
        ),
    )


@eqx.filter_jit
def _put(pool: FramePool, new: FramePool, rows: Int[Array, " r"]) -> FramePool:
    def points_and_roots(p: FramePool) -> tuple:
        kept = (p.points, p.parts, p.distance, p.root, p.others, p.others_valid)
        return (*kept, p.found, p.several)

    old = points_and_roots(pool)
    put = jax.tree.map(lambda a, b: a.at[rows].set(b), old, points_and_roots(new))
    return eqx.tree_at(points_and_roots, pool, put)
