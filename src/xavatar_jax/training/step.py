"""One step of training, jitted: draw a batch, differentiate, update."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..fields import TabulatedSkinning
from .batch import Batch
from .config import FitConfig, for_programs, has_guide
from .devices import ONE_DEVICE, Devices
from .model import AvatarFields, trainable_filter
from .objective import (
    Anchors,
    ExtraTerms,
    full_objective,
    geometry_objective,
    skinning_objective,
    with_extra,
)
from .pool import FramePool


class Fall(NamedTuple):
    """Of rates that fall: a share of the way was over at one step, and all of it is at another.

    It may change while a run goes on: it is no constant of the compiled step.
    """

    since: Int[Array, ""]
    share: Float[Array, ""]
    end: Int[Array, ""]

    @classmethod
    def create(cls, end: int, *, since: int = 0, share: float = 0.0) -> Fall:
        return cls(
            jnp.asarray(since, jnp.int32),
            jnp.asarray(share, jnp.float32),
            jnp.asarray(end, jnp.int32),
        )


class TrainState(eqx.Module):
    """What a step changes: learned leaves, an optimiser state for each field, steps done.

    `fall`: when a falling rate is at its end; `guide`: the learned leaves of the skinning field as
    the guide of the searches has it, if they have one.
    """

    learned: AvatarFields
    optimisers: dict[str, Any]
    step: Int[Array, ""]
    fall: Fall
    guide: Any = None


Step = Callable[
    [TrainState, FramePool, TabulatedSkinning | None, Int[Array, ""]],
    tuple[TrainState, dict[str, Array]],
]


def make_optimiser(config: FitConfig) -> optax.GradientTransformation:
    """Adam after a global-norm clip, at a rate of one: see `rate_factor` for the rate."""
    options = config.optimiser
    return optax.chain(
        optax.clip_by_global_norm(options.clip), optax.scale_by_adam(eps=options.epsilon)
    )


def rate_factor(config: FitConfig, step: Int[Array, ""], fall: Fall) -> Float[Array, ""]:
    """The part of the learning rates at a step: rising first, then to a hundredth at the last."""
    risen = jnp.minimum((step + 1) / max(config.optimiser.warmup, 1), 1.0)
    if config.optimiser.schedule == "constant":
        return risen
    over = (step - fall.since) / jnp.maximum(fall.end - fall.since, 1).astype(jnp.float32)
    return risen * cosine(fall.share + (1 - fall.share) * over)


def cosine(share: Float[Array, ""]) -> Float[Array, ""]:
    """What is left of a rate that falls to a hundredth, when a share of the way is over."""
    return jnp.asarray(optax.cosine_decay_schedule(1.0, 1, alpha=0.01)(share))


def draw_batch(
    pool: FramePool,
    config: FitConfig,
    points: int,
    several: int,
    key: PRNGKeyArray,
    *,
    held: int = 0,
) -> Batch:
    """Random frames, none of the last `held`, and `points` random points of each."""
    frame_key, *keys = jax.random.split(key, 3)
    last = pool.points.shape[0] - held
    chosen = jax.random.randint(frame_key, (config.frames_per_step,), 0, last)
    return batch_of(pool, chosen, points, several, *keys)


def batch_of(
    pool: FramePool,
    chosen: Int[Array, " B"],
    points: int,
    several: int,
    several_key: PRNGKeyArray,
    single_key: PRNGKeyArray,
) -> Batch:
    """`points` random points of each chosen frame, `several` from those with many roots."""
    # A frame without points of several roots gives its first ones, which have none but one.
    first = jnp.minimum(pool.several[chosen], pool.others.shape[1])
    rows = jnp.concatenate(
        [
            _uniform_index(several_key, several, 0 * first, jnp.maximum(first, 1)),
            _uniform_index(single_key, points - several, first, pool.found[chosen]),
        ],
        axis=1,
    )

    def take(leaf: Array, rows: Array = rows) -> Array:
        return leaf[chosen[:, None], rows]

    return Batch(
        points=take(pool.points),
        parts=take(pool.parts).astype(jnp.int32),
        distance=take(pool.distance),
        root=take(pool.root),
        rooted=rows < pool.found[chosen, None],
        others=take(pool.others, rows[:, :several]),
        others_valid=take(pool.others_valid, rows[:, :several]),
        transforms=pool.transforms[chosen],
        params=jax.tree.map(lambda leaf: leaf[chosen], pool.params),
    )


def _uniform_index(
    key: PRNGKeyArray, count: int, low: Int[Array, " B"], high: Int[Array, " B"]
) -> Int[Array, "B n"]:
    """`count` integers a row, from `low` to below `high`."""
    u = jax.random.uniform(key, (low.shape[0], count))
    span = jnp.maximum(high - low, 1)[:, None]
    return low[:, None] + jnp.minimum((u * span).astype(jnp.int32), span - 1)


def rows_with_several(pool: FramePool, points: int) -> int:
    """How many of a frame's drawn points are taken from those with several roots: their share."""
    share = pool.share
    if share is None:
        share = pool.several.sum() / jnp.maximum(pool.found.sum(), 1)
    return min(int(np.ceil(points * float(share))), points)


def make_steps(
    fields: AvatarFields,
    pool: FramePool,
    anchors: Anchors,
    config: FitConfig,
    *,
    held: int = 0,
    devices: Devices = ONE_DEVICE,
    terms: ExtraTerms | None = None,
) -> tuple[TrainState, dict[str, Step]]:
    """The first state, and the jitted steps by what they learn.

    A step is `(state, pool, guide, k) -> (state, terms)`; `guide` is None unless
    `has_guide(config)`, and `k` is the number of steps done.
    With stored roots there is one for "geometry" and, if it is learned, one for "skinning"; with
    roots searched in the step one for "both"; `terms` are added to each. Draws are keyed by seed
    and step number alone, and leave out the pool's last `held` frames. A step whose loss or
    gradient is not finite changes nothing, and neither do those that are begun after it before
    anybody has looked: their `k` is not the state's.
    """
    learned, fixed = eqx.partition(fields, trainable_filter(fields, config))
    # A copy: a step gives its input state's memory to the next one.
    learned = jax.tree.map(jnp.copy, learned)
    # Frozen arrays are arguments, not constants: baked in, they would be folded at compile time.
    fixed_arrays, static = eqx.partition(fixed, eqx.is_array)
    optimisers: dict[str, Any] = {}
    steps: dict[str, Step] = {}
    read = for_programs(config)

    def bind(plan: _Plan) -> Step:
        return lambda state, pool, guide, k: _step(
            (pool, guide, anchors, fixed_arrays, k, dict(terms or {})),
            *(state, static, plan, read, devices),
        )

    for plan in _plans(pool, config, held):
        optimisers[plan.name] = make_optimiser(config).init(_own(learned, plan.name))
        steps[plan.name] = bind(plan)
    at, fall = jnp.zeros((), jnp.int32), Fall.create(config.steps)
    guide = jax.tree.map(jnp.copy, learned.skinning) if has_guide(config) else None
    return TrainState(learned, optimisers, at, fall, guide), steps


@dataclass(frozen=True)
class _Plan:
    """What a kind of step learns, and what it draws. Values alone, so that equal ones share code.

    `points` a frame, `several` of them from those with many roots, none of the last `held` frames.
    """

    name: str
    points: int
    several: int
    held: int


def _plans(pool: FramePool, config: FitConfig, held: int) -> list[_Plan]:
    points = config.points_per_step
    if not config.search.cached:
        return [_Plan("both", points, 0, held)]
    several = rows_with_several(pool, points)
    plans = [_Plan("geometry", points, several, held)]
    if config.skinning.learned:
        count = min(config.skinning_points, points)
        plans.append(_Plan("skinning", count, min(several, count), held))
    return plans


def _own(learned: AvatarFields, name: str) -> Any:
    """The leaves that a step of this name learns."""
    return {"geometry": learned.geometry, "skinning": learned.skinning, "both": learned}[name]


def _with_own(learned: AvatarFields, name: str, own: Any) -> AvatarFields:
    if name == "both":
        return own
    return eqx.tree_at(lambda f: getattr(f, name), learned, own)


def _at_rates(updates: Any, name: str, config: FitConfig, left: Array) -> Any:
    """Steps of length one against the gradient, times a rate for each field."""
    rates = {
        "geometry": config.optimiser.learning_rate, "skinning": config.optimiser.skinning_rate
    }  # fmt: skip

    def scaled(tree: Any, rate: float) -> Any:
        return jax.tree.map(lambda leaf: -rate * left * leaf, tree)

    if name != "both":
        return scaled(updates, rates[name])
    # One clip over all, as the paper has it, but a rate for each field.
    own = (scaled(updates.skinning, rates["skinning"]), scaled(updates.geometry, rates["geometry"]))
    return eqx.tree_at(lambda u: (u.skinning, u.geometry), updates, own)


# Made once: a second run of the same shapes and options does not compile again.
@eqx.filter_jit(donate="all-except-first")
def _step(
    constant: tuple[FramePool, TabulatedSkinning | None, Anchors, Any, Int[Array, ""], ExtraTerms],
    state: TrainState,
    static: Any,
    plan: _Plan,
    config: FitConfig,
    devices: Devices,
) -> tuple[TrainState, dict[str, Array]]:
    pool, guide, anchors, fixed_arrays, k, extra = constant
    name = plan.name
    prefix = "skinning_" if name == "skinning" else ""
    objective = {
        "geometry": geometry_objective,
        "skinning": skinning_objective,
        "both": partial(full_objective, guide=guide, devices=devices),
    }[name]
    objective = with_extra(objective, extra, prefix)
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    batch_key, loss_key = jax.random.split(key)
    batch = draw_batch(pool, config, plan.points, plan.several, batch_key, held=plan.held)
    batch = devices.spread(batch)

    def loss(own: Any) -> tuple[Array, dict[str, Array]]:
        learned = _with_own(state.learned, name, own)
        fields = eqx.combine(learned, fixed_arrays, static)
        return objective(fields, batch, anchors, config, loss_key)

    own = _own(state.learned, name)
    (total, terms), gradient = jax.value_and_grad(loss, has_aux=True)(own)
    updates, optimiser_state = make_optimiser(config).update(gradient, state.optimisers[name], own)
    updates = _at_rates(updates, name, config, rate_factor(config, state.step, state.fall))
    learned = _with_own(state.learned, name, eqx.apply_updates(own, updates))
    optimisers = {**state.optimisers, name: optimiser_state}
    after = TrainState(learned, optimisers, state.step + 1, state.fall, state.guide)
    size = optax.tree.norm(gradient)
    good = jnp.isfinite(total) & jnp.isfinite(size) & (state.step == k)
    after = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, state)
    return devices.whole(after), {f"{prefix}loss": total, f"{prefix}gradient": size, **terms}


def with_learned(fields: AvatarFields, state: TrainState) -> AvatarFields:
    """Fields with the state's learned leaves in place, copied: a step reuses the state's memory."""
    return eqx.combine(jax.tree.map(jnp.copy, state.learned), fields)
