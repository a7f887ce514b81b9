"""Validation: a loss on data that training does not see, the best model, and plateaus."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclass(frozen=True)
class Validation:
    """When and how a run is validated.

    - `loss`: `loss(model, data)`, a scalar; an `eqx.Module` shares its compiled program.
    - `every`: steps between two validations.
    - `patience`: steps without a gain after which training ends (0: never). With rates that fall,
      they count from half of the steps on, and the rates then fall to their end within as many
      steps more.
    - `gain`: the share by which the loss must fall to count as a gain.
    """

    loss: Callable[[Any, Any], Float[Array, ""]]
    every: int = 50
    patience: int = 300
    gain: float = 0.005

    def __call__(self, model: Any, data: Any) -> float:
        """The loss of a model."""
        return float(_loss(self.loss, model, data))


@eqx.filter_jit
def _loss(loss: Any, model: Any, data: Any) -> Float[Array, ""]:
    return loss(model, data)


@dataclass
class Best:
    """The model with the smallest validation loss, and the step of the last gain.

    Among losses that differ by less than a gain the latest wins: its learning rate was lower.
    """

    loss: float = float("inf")
    step: int = 0
    learned: Any = None
    least: float = float("inf")
    mark: float = float("inf")
    gained: int = 0

    def update(self, step: int, loss: float, learned: Any, gain: float) -> None:
        """Keep the learned leaves if their loss is the smallest so far."""
        self.least = min(self.least, loss)
        if loss <= self.least * (1 + gain):
            self.loss, self.step = loss, step
            self.learned = jax.tree.map(jnp.copy, learned)
        # The first loss always counts as a gain.
        if not math.isfinite(self.mark) or loss < self.mark * (1 - gain):
            self.mark, self.gained = loss, step

    def plateau(self, step: int, patience: int, *, from_step: int = 0) -> bool:
        """Whether there was no gain for `patience` steps, counted from `from_step` on."""
        if not patience or not math.isfinite(self.mark):
            return False
        return step - max(self.gained, from_step) >= patience

    def to_dict(self) -> dict[str, float]:
        """Plain values without the learned leaves."""
        names = ("loss", "step", "least", "mark", "gained")
        return {name: getattr(self, name) for name in names}
