"""Stages: what a step draws, which loss terms it lowers, and which leaves it updates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .devices import Devices

Term = Callable[[Any, Any, PRNGKeyArray], Any]
"""A loss term `term(model, batch, key)`: a scalar, or a sum and the count to divide it by."""
Weight = float | optax.Schedule
"""The weight of a term, or its course over the run as a function of the share that is done."""
Terms = Mapping[str, tuple[Weight, Term]]
"""Loss terms by name, each with its weight. A weight of 0 records a term without training on it."""
Values = dict[str, Float[Array, ""]]
Loss = Callable[[Any, Any, PRNGKeyArray], tuple[Float[Array, ""], Values]]
Gradient = Callable[[Loss, Any, Any, PRNGKeyArray], tuple[tuple[Float[Array, ""], Values], Any]]
"""`gradient(loss, own, batch, key) -> ((total, values), direction)`. See `autodiff`."""

FALLING = optax.cosine_decay_schedule(1.0, 1, alpha=0.01)
"""A schedule over the run: the rates fall along a cosine to a hundredth at its end."""
STEPWISE = optax.piecewise_constant_schedule(1.0, {0.5: 0.1, 0.75: 0.1})  # pyright: ignore[reportArgumentType]
"""A schedule over the run: the rates fall to a tenth at one half and again at three quarters."""
CONSTANT = optax.constant_schedule(1.0)
"""A schedule over the run: the rates stay as they are."""


def autodiff(loss: Loss, own: Any, batch: Any, key: PRNGKeyArray) -> Any:
    """The gradient of `loss(own, batch, key)` with respect to `own`."""
    return jax.value_and_grad(loss, has_aux=True)(own, batch, key)


class Stage(eqx.Module):
    """One kind of update.

    Callables that hold settings or arrays should be `eqx.Module`s: two runs whose stages have
    equal settings and array shapes then share one compiled program.

    - `name`: names the stage in messages and in the optimiser states.
    - `draw`: `draw(model, data, key) -> batch`. Not differentiated, so a search for roots or any
        other choice that has no derivative belongs here.
    - `terms`: the loss terms and their weights.
    - `optimiser`: an optax transformation, learning rates included.
    - `learns`: `learns(model)` gives a tree of booleans that marks the leaves to update.
    - `schedule`: a factor on the updates as a function of the share of the run that is done
        (0 to 1), for example `FALLING`.
    - `every`: the stage takes each step whose number is a multiple of it. Where several stages
        are due, the last one in the list takes the step.
    - `prefix`: prepended to the names of the terms in the history and the log.
    - `forward`: `forward(model, batch, key)`, a differentiable computation that the terms share:
        they receive its result instead of the batch.
    - `gradient`: how the update direction is computed: `autodiff`, or for example Reptile's
        difference between the parameters before and after an inner loop.
    """

    name: str = eqx.field(static=True)
    draw: Callable[[Any, Any, PRNGKeyArray], Any]
    terms: Terms
    optimiser: optax.GradientTransformation
    learns: Callable[[Any], PyTree[bool]]
    schedule: optax.Schedule = eqx.field(static=True, default=CONSTANT)
    every: int = eqx.field(static=True, default=1)
    prefix: str = eqx.field(static=True, default="")
    forward: Callable[[Any, Any, PRNGKeyArray], Any] | None = None
    gradient: Gradient = eqx.field(default=autodiff)

    def __check_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"stage {self.name!r}: every is {self.every}; it must be at least 1")


class Decay(NamedTuple):
    """The course of a run: a share of it was over at step `since`, all of it is at step `end`.

    An array, not a constant of the compiled step: a plan or a plateau may move the end.
    """

    since: Int[Array, ""]
    share: Float[Array, ""]
    end: Int[Array, ""]

    @classmethod
    def create(cls, end: int, *, since: int = 0, share: float = 0.0) -> Decay:
        """The course of a run that ends at step `end`."""
        return cls(
            jnp.asarray(since, jnp.int32),
            jnp.asarray(share, jnp.float32),
            jnp.asarray(end, jnp.int32),
        )

    def done(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """The share of the run that is over at a step, 0 to 1."""
        span = jnp.maximum(self.end - self.since, 1).astype(jnp.float32)
        over = (step - self.since).astype(jnp.float32) / span
        return jnp.clip(self.share + (1 - self.share) * over, 0, 1)


class TrainState(eqx.Module):
    """What a step changes: the learned leaves, an optimiser state per stage, the step number."""

    learned: Any
    optimisers: dict[str, Any]
    step: Int[Array, ""]
    decay: Decay


class Setup(eqx.Module):
    """A model split for training: the leaves that some stage learns, and the rest.

    `masks`: per stage, which of the learned leaves it updates.
    """

    frozen: Any
    masks: dict[str, Any]

    @classmethod
    def create(cls, model: Any, stages: tuple[Stage, ...], steps: int) -> tuple[TrainState, Setup]:
        """The state before the first step, and what stays fixed.

        **Raises:** `ValueError` for two stages of one name, or a stage that learns nothing.
        """
        names = [stage.name for stage in stages]
        if len(set(names)) < len(names):
            raise ValueError(f"stages must have different names, found {names}")
        masks = {stage.name: stage.learns(model) for stage in stages}
        union = jax.tree.map(lambda *flags: any(flags), *masks.values())
        learned, frozen = eqx.partition(model, union)
        # A copy: a step gives the memory of its input state to the next one.
        learned = jax.tree.map(jnp.copy, learned)
        optimisers = {}
        for stage in stages:
            own = eqx.filter(learned, masks[stage.name])
            if not jax.tree.leaves(own):
                raise ValueError(f"stage {stage.name!r} has no leaf to learn")
            optimisers[stage.name] = stage.optimiser.init(own)
        state = TrainState(learned, optimisers, jnp.zeros((), jnp.int32), Decay.create(steps))
        return state, cls(frozen, masks)

    def model(self, state: TrainState) -> Any:
        """The model in a state. Its learned leaves are copies, which outlive the next step."""
        return eqx.combine(jax.tree.map(jnp.copy, state.learned), self.frozen)


# One function for all runs: a second run of equal shapes and settings does not compile again.
# Frozen arrays are arguments: as constants they would be folded at compile time.
@eqx.filter_jit(donate="all-except-first")
def update(
    constant: tuple[Stage, Setup, Any, Int[Array, ""], Int[Array, ""], Devices], state: TrainState
) -> tuple[TrainState, Values]:
    """One step of a stage: draw, differentiate, update.

    Draws are keyed by seed and step number alone. If the loss or the gradient is not finite,
    the state is returned unchanged; so do the steps that were dispatched before the host noticed,
    because their number `k` is then not the state's.
    """
    stage, setup, data, seed, k, devices = constant
    own, rest = eqx.partition(state.learned, setup.masks[stage.name])
    done = state.decay.done(state.step)
    draw_key, loss_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), state.step))
    batch = stage.draw(eqx.combine(state.learned, setup.frozen), data, draw_key)

    def loss(own: Any, batch: Any, key: PRNGKeyArray) -> tuple[Float[Array, ""], Values]:
        model = eqx.combine(own, rest, setup.frozen)
        keys = jax.random.split(key, len(stage.terms) + 1)
        if stage.forward is not None:
            batch = stage.forward(model, batch, keys[-1])
        total, values = jnp.zeros(()), {}
        for own_key, (name, (weight, term)) in zip(keys, stage.terms.items(), strict=False):
            values[name] = mean_value(term(model, batch, own_key))
            weight = weight(done) if callable(weight) else weight
            if isinstance(weight, Array) or weight:
                total = total + weight * values[name]
        return total, values

    (total, values), gradient = stage.gradient(loss, own, batch, loss_key)
    updates, optimiser = stage.optimiser.update(gradient, state.optimisers[stage.name], own)
    updates = optax.tree.scale(stage.schedule(done), updates)
    after = TrainState(
        eqx.combine(eqx.apply_updates(own, updates), rest),
        {**state.optimisers, stage.name: optimiser},
        state.step + 1,
        state.decay,
    )
    size = optax.tree.norm(gradient)
    good = finite(total, size) & (state.step == k)
    after = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, state)
    record = {"loss": total, "gradient": size, **values}
    return devices.whole(after), {f"{stage.prefix}{name}": v for name, v in record.items()}


def mean_value(term: Any) -> Float[Array, ""]:
    """A term's value: a scalar as it is, a `(sum, count)` pair divided."""
    if isinstance(term, tuple):
        total, count = term
        return total / jnp.maximum(count, 1)
    return jnp.asarray(term)


def finite(*values: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether all of the scalars are finite."""
    return jnp.isfinite(jnp.stack(values)).all()


def stage_at(stages: tuple[Stage, ...], step: int) -> Stage:
    """The stage that takes a step: the last one in the list that is due."""
    due = [stage for stage in stages if step % stage.every == 0]
    return due[-1] if due else stages[0]
