"""A run of SCANimate: scans, two stages of skinning, one of shape, and an avatar of them."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from ...avatar import Avatar
from ...body import BodyModel, canonical_vertices
from ...fields import AbstractSkinningField
from ...frames import Frames, known_body
from ...sampling import varied_frames
from ...training import (
    AvatarFields,
    History,
    TrainingError,
    fresh_fields,
    initial_fields,
    settle_on_person,
    subject_betas,
    trainable_geometry,
    trainable_skinning,
)
from ...training.budget import check_minutes, frames_in_budget
from ...training.progress import progress
from ...training.step import cosine
from ..baseline import Baseline
from ..skeleton import body_only, body_only_frames
from .config import ScanimateConfig, Stage, scanimate_quick
from .fields import InverseSkinning, LocalPoseMLP, SoftmaxSkinning
from .hands import moves_with_wrist, static_hands
from .objective import (
    CanonicalScans,
    SkinNets,
    Template,
    canonicalise,
    shape_objective,
    skin_objective,
)
from .scans import Scans, edge_stretch, read_scans

_REPORT_EVERY = 25


def fit_scanimate(
    frames: Frames,
    config: ScanimateConfig | None = None,
    *,
    body: BodyModel | None = None,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
) -> Baseline:
    """Learn SCANimate's avatar of the person in `frames`, on a body-only skeleton.

    `config` is `scanimate_quick()` unless given; fingers, jaw, eyes and expression of the frames'
    parameters are not used. `cache` is the folder of the fields fitted to the mean shape.

    **Raises:** `ValueError` for minutes that are not positive, or a body without a body;
    `TrainingError` naming the stage and the term that is not finite.
    """
    config = scanimate_quick() if config is None else config
    check_minutes(config.minutes)
    started = time.perf_counter()
    whole = known_body(frames, body)
    cut = body_only(whole)
    count = min(frames_in_budget(config) or len(frames), len(frames))
    learned_from = body_only_frames(cut, frames[varied_frames(frames.params, count)])
    betas = subject_betas(frames)
    history = History()

    fields = start_fields(cut, config, cache=cache, verbose=verbose)
    fields = settle_on_person(cut, fields, betas, config.start)
    clock = history.lap("prefit", started)
    with progress("scans", len(learned_from), verbose=verbose, unit="frame") as bar:
        scans = read_scans(cut, learned_from, betas, config, bar=bar)
    template = _template(cut, betas)
    clock = history.lap("data", clock)

    end = math.inf if config.minutes is None else started + 60 * config.minutes
    left = end - clock
    spent = 0.0
    nets = SkinNets(fields.skinning, _inverse(cut, scans, config))
    for name, stage in (("skin", config.skin), ("cycle", config.cycle)):
        spent += stage.share
        until = end - (1 - spent) * left if math.isfinite(end) else math.inf
        objective = _cycle_loss if name == "cycle" else _skin_loss
        constant = (scans, template)
        nets = _run(name, stage, nets, objective, constant, config, until, history, verbose)
        clock = history.lap(name, clock)
    hands = static_hands(whole, frames.params, betas) if config.hands == "body" else None
    canonical = _canonical(nets, scans, hands, config)
    geometry = _with_skinning(fields.geometry.within(learned_from.params), nets.forward)
    clock = history.lap("canonical", clock)
    geometry = _run(
        "shape",
        config.shape,
        geometry,
        _shape_loss,
        (canonical, template),
        config,
        end,
        history,
        verbose,
    )
    history.lap("shape", clock)
    history.lap("total", started)
    history.stopped = "steps" if time.perf_counter() < end else "minutes"
    learned = AvatarFields(nets.forward, geometry)
    avatar = Avatar(cut, betas, learned, config.start, history.steps_done)
    return Baseline(whole, avatar, history, learned_from)


def start_fields(
    body: BodyModel,
    config: ScanimateConfig,
    *,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
) -> AvatarFields:
    """Forward net and distance on a body-only skeleton, fitted to the body's mean shape.

    Kept in the cache folder, as `initial_fields` does.
    """
    own = None
    if config.forward is not None or config.distance is not None:
        key_forward, key_distance = jax.random.split(jax.random.key(config.seed))
        own = fresh_fields(body, config.start)
        if config.forward is not None:
            forward = SoftmaxSkinning(body.tree, config.forward, key=key_forward)
            own = eqx.tree_at(lambda f: f.skinning, own, forward)
        if config.distance is not None:
            distance = LocalPoseMLP(
                body.tree,
                own.skinning,
                config.distance,
                softness=config.start.losses.softness,
                key=key_distance,
            )
            own = eqx.tree_at(lambda f: f.geometry, own, distance)
    return initial_fields(body, config.start, cache=cache, verbose=verbose, fields=own)


def _with_skinning(geometry: Any, skinning: AbstractSkinningField) -> Any:
    """A local network reads the weights of this field from now on."""
    if isinstance(geometry, LocalPoseMLP):
        return eqx.tree_at(lambda g: g.skinning, geometry, skinning)
    return geometry


def _template(body: BodyModel, betas: Any) -> Template:
    vertices = canonical_vertices(body, jnp.asarray(betas, body.template.dtype))
    return Template(jnp.asarray(vertices, jnp.float32), jnp.asarray(body.weights, jnp.float32))


def _inverse(body: BodyModel, scans: Scans, config: ScanimateConfig) -> InverseSkinning:
    return InverseSkinning(
        body.tree,
        config.inverse,
        frames=scans.corners.shape[0],
        latent=config.latent,
        known=config.known,
        key=jax.random.fold_in(jax.random.key(config.seed), 1),
    )


def _canonical(
    nets: SkinNets,
    scans: Scans,
    hands: tuple[np.ndarray, np.ndarray] | None,
    config: ScanimateConfig,
) -> CanonicalScans:
    """All triangles by the inverse net; those of `hands` in place of the scans'.

    Others of their frame stand for those that are torn apart.
    """
    rng = np.random.default_rng((config.seed, 1))
    places = np.asarray(_carry(nets, scans)).reshape(scans.corners.shape)
    stretch = edge_stretch(np.asarray(scans.corners), places)
    good = np.isfinite(stretch) & (stretch < config.stretch)
    on_hand = moves_with_wrist(scans.params.tree, np.asarray(scans.known))
    corners = []
    for frame, kept, of_hand in zip(places, good, on_hand, strict=True):
        rows = np.flatnonzero(kept)
        rows = rows if len(rows) else np.arange(len(kept))
        whole = frame[np.where(kept, np.arange(len(kept)), rng.choice(rows, len(kept)))]
        if hands is not None:
            triangles, share = hands
            whole[of_hand] = triangles[rng.choice(len(triangles), int(of_hand.sum()), p=share)]
        corners.append(whole)
    return CanonicalScans(jnp.asarray(np.stack(corners), jnp.float32), scans.params)


@eqx.filter_jit
def _carry(nets: SkinNets, scans: Scans) -> Float[Array, "F n 3"]:
    def one_frame(frame: tuple[Array, ...]) -> Array:
        latent, corners, known, transforms = frame
        count = corners.shape[0] * 3
        return canonicalise(
            nets, latent, corners.reshape(count, 3), known.reshape(count, -1), transforms
        )[0]

    return jax.lax.map(
        one_frame, (nets.inverse.latents, scans.corners, scans.known, scans.transforms)
    )


def _run(
    name: str,
    stage: Stage,
    model: Any,
    objective: Callable[..., Any],
    constant: Any,
    config: ScanimateConfig,
    until: float,
    history: History,
    verbose: bool,
) -> Any:
    """Steps of one stage, until there are enough or its time is up: one at least, if any."""
    if not stage.steps:
        return model
    mask = _learned(model, config)
    learned, fixed = eqx.partition(model, mask)
    arrays, static = eqx.partition(fixed, eqx.is_array)
    state = _optimiser(config).init(learned)
    began = time.perf_counter()
    with progress(name, stage.steps, verbose=verbose, unit="step") as bar:
        for k in range(stage.steps):
            done = k / stage.steps
            if math.isfinite(until):
                now = time.perf_counter()
                if k and now >= until:
                    break
                done = max(done, (now - began) / max(until - began, 1e-9))
            done = jnp.asarray(min(done, 1.0), jnp.float32)
            learned, state, terms = _step(
                learned, state, jnp.asarray(k), done, constant, arrays,
                static, objective, stage, config,
            )  # fmt: skip
            if not k:  # the schedule is over the time without compilation
                jax.block_until_ready(learned)
                began = time.perf_counter()
            history.steps_done += 1
            bar.update(1)
            if k % _REPORT_EVERY == 0:
                values = _checked(terms, name, k)
                history.record(history.steps_done, values)
                bar.set_postfix(loss=f"{values[f'{name}_loss']:.5f}")
    # What follows is made of these fields, whatever ended the stage.
    if history.steps_done not in history.steps:
        history.record(history.steps_done, _checked(terms, name, k))
    history.best_step = history.steps_done
    return eqx.combine(learned, fixed)


@eqx.filter_jit
def _step(
    learned: Any,
    state: Any,
    k: Array,
    done: Array,
    constant: Any,
    arrays: Any,
    static: Any,
    objective: Callable[..., Any],
    stage: Stage,
    config: ScanimateConfig,
) -> tuple[Any, Any, dict[str, Array]]:
    key = jax.random.fold_in(jax.random.key(config.seed), k)

    def loss(own: Any) -> tuple[Array, dict[str, Array]]:
        return objective(eqx.combine(own, arrays, static), constant, config, done, key)

    (total, terms), gradient = jax.value_and_grad(loss, has_aux=True)(learned)
    updates, state = _optimiser(config).update(gradient, state, learned)
    rate = learning_rate(stage, done)
    learned = eqx.apply_updates(learned, jax.tree.map(lambda u: -rate * u, updates))
    return learned, state, {"loss": total, **terms}


def learning_rate(stage: Stage, done: Float[Array, ""]) -> Float[Array, ""]:
    """The rate when a share of the stage's steps or time is over."""
    if stage.schedule == "cosine":
        return stage.rate * cosine(done)
    return stage.rate * 0.1 ** ((done >= 0.5).astype(float) + (done >= 0.75))


def _optimiser(config: ScanimateConfig) -> optax.GradientTransformation:
    epsilon = config.start.optimiser.epsilon
    return optax.chain(optax.clip_by_global_norm(config.clip), optax.scale_by_adam(eps=epsilon))


def _learned(model: Any, config: ScanimateConfig) -> Any:
    """A tree of booleans: which leaves a stage learns."""
    if isinstance(model, SkinNets):
        forward = trainable_skinning(model.forward, learned=config.start.skinning.learned)
        return SkinNets(forward, jax.tree.map(eqx.is_inexact_array, model.inverse))
    mask = trainable_geometry(model)
    if isinstance(model, LocalPoseMLP):
        mask = eqx.tree_at(
            lambda m: m.skinning, mask, jax.tree.map(lambda _: False, model.skinning)
        )
    return mask


def _skin_loss(nets: SkinNets, constant: Any, config: Any, done: Any, key: Any):
    scans, template = constant
    return skin_objective(nets, scans, template, config, done, key, cycle=False)


def _cycle_loss(nets: SkinNets, constant: Any, config: Any, done: Any, key: Any):
    scans, template = constant
    return skin_objective(nets, scans, template, config, done, key, cycle=True)


def _shape_loss(geometry: Any, constant: Any, config: Any, done: Any, key: Any):
    scans, template = constant
    return shape_objective(geometry, scans, template, config, key)


def _checked(terms: dict[str, Array], name: str, step: int) -> dict[str, float]:
    """The terms of a step by their names in the history, if all are finite."""
    values = {f"{name}_{n}": float(v) for n, v in terms.items()}
    # The sum comes last: it is not finite because a term is not.
    for term in sorted(values, key=lambda n: n.endswith("loss")):
        if not math.isfinite(values[term]):
            raise TrainingError(
                f"the {term} term is {values[term]} at step {step} of stage {name}: training has "
                "stopped. Lower the rate, or look for a frame whose mesh and parameters do not "
                "belong together.",
                step=step,
                term=term,
            )
    return values
