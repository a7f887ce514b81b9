"""Frames that training does not learn from but is judged by: when to stop, which fields to keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..fields import TabulatedSkinning
from ..frames import Frames, spread
from .config import FitConfig, ValidationConfig, for_programs
from .model import AvatarFields
from .objective import Anchors, full_objective, skinning_objective
from .pool import FramePool
from .step import batch_of, rows_with_several

_KEY = 0x5EED  # of the points that are asked: the same ones each time


def split_validation(
    frames: Frames, config: ValidationConfig
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " v"]]:
    """Indices of the frames to learn from, and of those to be judged by.

    The last `share` of each sequence is left out of learning; of what was left out, `frames` are
    asked, spread over the sequences. A sequence of fewer than `1 / share` frames leaves out none.
    """
    index = frames.sequence_index
    held = np.zeros(len(frames), bool)
    for sequence in np.unique(index):
        rows = np.flatnonzero(index == sequence)
        held[rows[len(rows) - int(config.share * len(rows) + 1e-9) :]] = True
    rows = np.flatnonzero(held)
    if not len(rows) or not config.frames:
        return np.arange(len(frames)), np.zeros(0, np.int64)
    return np.flatnonzero(~held), rows[spread(frames[rows], config.frames)]


def make_validation(
    pool: FramePool, anchors: Anchors, config: FitConfig, held: int
) -> Callable[[AvatarFields, FramePool, TabulatedSkinning | None], Float[Array, ""]]:
    """A function of fields, pool and guide: the occupancy term on the last `held` frames.

    Points are the same in every call. Where roots are stored, they are polished on the fields'
    own skinning; else they are searched.
    """
    count = min(config.validation.points, pool.points.shape[1])
    several = rows_with_several(pool, count) if config.search.cached else 0
    read = for_programs(config)
    return lambda fields, pool, guide: _loss(
        fields, pool, guide, anchors, read, held, count, several
    )


@eqx.filter_jit
def _loss(
    fields: AvatarFields,
    pool: FramePool,
    guide: TabulatedSkinning | None,
    anchors: Anchors,
    config: FitConfig,
    held: int,
    count: int,
    several: int,
) -> Float[Array, ""]:
    chosen = jnp.arange(pool.points.shape[0] - held, pool.points.shape[0])
    several_key, single_key, key = jax.random.split(jax.random.key(_KEY), 3)
    batch = batch_of(pool, chosen, count, several, several_key, single_key)
    objective = skinning_objective if config.search.cached else partial(full_objective, guide=guide)
    name = "skinning_occupancy" if config.search.cached else "occupancy"
    return objective(fields, batch, anchors, config, key)[1][name]


@dataclass
class Best:
    """The fields with the least loss on the validation frames, and when there was a gain.

    Of losses that differ by less than a gain, the latest counts: its rate was lower.
    """

    loss: float = float("inf")
    step: int = 0
    learned: Any = None
    least: float = float("inf")
    mark: float = float("inf")
    gained: int = 0

    def update(self, step: int, loss: float, learned: Any, config: ValidationConfig) -> None:
        """Take the fields if their loss is the least so far; note a gain worth waiting for."""
        self.least = min(self.least, loss)
        if loss <= self.least * (1 + config.gain):
            self.loss, self.step = loss, step
            self.learned = jax.tree.map(jnp.copy, learned)
        # The first loss is a gain over none, whatever the share asked for.
        if not np.isfinite(self.mark) or loss < self.mark * (1 - config.gain):
            self.mark, self.gained = loss, step

    def plateau(self, step: int, config: FitConfig, total: int | None = None) -> bool:
        """Whether there was no gain for so long that training, of `total` steps, can stop.

        With a falling rate, only the second half of the steps counts: a loss that stands still
        under a high rate often falls again as the rate does.
        """
        patience = config.validation.patience
        if not patience or not np.isfinite(self.mark):
            return False
        since = self.gained
        if config.optimiser.schedule == "cosine":
            since = max(since, (config.steps if total is None else total) // 2)
        return step - since >= patience

    def to_dict(self) -> dict[str, float]:
        """Plain values without the fields."""
        names = ("loss", "step", "least", "mark", "gained")
        return {name: getattr(self, name) for name in names}
