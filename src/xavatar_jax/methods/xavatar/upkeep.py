"""X-Avatar's work between training steps: polished roots, a renewed guide, redrawn points."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import equinox as eqx

from ...fields import AvatarModel, PartGrids, learned_leaves
from .roots import (
    FrameData,
    polish_roots,
    replace_frames,
    rows_in_turn,
    tabulated,
)


@dataclass(frozen=True)
class RootPolish:
    """The cached roots of the next `frames` frames follow the skinning field.

    Frames take turns, because polishing all roots of a long capture takes longer than the steps in
    between.
    """

    grids: PartGrids
    every: int
    frames: int
    name: str = "polish"
    repeatable: bool = True

    def __call__(self, model: AvatarModel, data: FrameData, step: int) -> FrameData:
        rows = rows_in_turn(step // self.every, self.frames, data.num_frames)
        table = tabulated(model.skinning, self.grids)
        return polish_roots(model, table, data, steps=1, rows=rows)


@dataclass(frozen=True)
class GuideRenewal:
    """The table on which searches begin follows the skinning field."""

    grids: PartGrids
    every: int
    name: str = "guide"
    repeatable: bool = True

    def __call__(self, model: AvatarModel, data: FrameData, step: int) -> FrameData:
        source = eqx.filter(model.skinning, learned_leaves(model.skinning))
        guide = tabulated(model.skinning, self.grids)
        return eqx.tree_at(
            lambda d: (d.guide, d.guide_source), data, (guide, source), is_leaf=lambda x: x is None
        )


class Redraw:
    """The points of the next `frames` frames are drawn again, ahead of time in a thread.

    Round r = 1, 2, ... takes effect after step r times `every`. Its points depend on seed, frame
    and round alone, and their roots are first searched on the model at the start, so nothing
    depends on when the thread did its work.

    - `make`: `make(rows, round)`, the data of these frames with roots.
    - `rounds`: how many rounds the run has.
    """

    name = "redraw"
    repeatable = False

    def __init__(
        self,
        make: Callable[..., FrameData],
        grids: PartGrids,
        *,
        every: int,
        frames: int,
        learned: int,
        rounds: int,
    ):
        self.every = every
        self._make, self._grids, self._rounds = make, grids, rounds
        self._frames, self._learned = frames, learned
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="redraw")
        self._waiting: Future[FrameData] | None = None

    def _rows(self, number: int):
        return rows_in_turn(number, self._frames, self._learned)

    def begin(self, step: int) -> None:
        """Let the thread make the first round that is due after this step."""
        number = step // self.every + 1
        self._waiting = None
        if number <= self._rounds:
            self._waiting = self._thread.submit(self._make, self._rows(number), number)

    def __call__(self, model: AvatarModel, data: FrameData, step: int) -> FrameData:
        """**Raises:** what reading a frame raises."""
        if self._waiting is None:
            return data
        new = self._waiting.result()
        if new.roots is not None:
            table = tabulated(model.skinning, self._grids)
            new = polish_roots(model, table, new, steps=2)
        data = replace_frames(data, new, self._rows(step // self.every))
        self.begin(step)
        return data

    def close(self) -> None:
        """End the thread after the round that it is working on."""
        self._thread.shutdown(cancel_futures=True)
