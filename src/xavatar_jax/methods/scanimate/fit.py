"""A run of SCANimate: scans, two stages of skinning, one of shape, and an avatar."""

from __future__ import annotations

import hashlib
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...avatar import Avatar, BodyOnlyAvatar, body_only, body_only_frames
from ...body import BodyModel, canonical_vertices
from ...fields import AvatarModel, mean_shape_model
from ...frames import Frames, known_body
from ...learning import (
    ONE_DEVICE,
    Callback,
    History,
    Identity,
    JsonLines,
    Keeper,
    Schedule,
    Stage,
    check_minutes,
    load_checkpoint,
    progress,
    train,
)
from ..observations import choose_frames, frames_digest, subject_betas
from ..result import Fit
from ..xavatar.start import starting_models
from .config import ScanimateConfig, scanimate_quick
from .networks import InverseSkinning, LocalPoseMLP, SoftmaxSkinning
from .scans import Scans, edge_stretch, moves_with_wrist, read_scans, static_hands
from .stages import CanonicalScans, SkinNets, Template, canonicalise, shape_stage, skin_stage

_FREE = ("minutes",)


def fit_scanimate(
    frames: Frames,
    config: ScanimateConfig | None = None,
    *,
    body: BodyModel | None = None,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
    callback: Callback | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    log: str | os.PathLike[str] | None = None,
) -> Fit:
    """Learn an avatar with SCANimate (Saito et al., CVPR 2021), on a body-only skeleton.

    `config` is `scanimate_quick()` unless given. Fingers, jaw, eyes and expression of the
    parameters are not used. Each stage has a checkpoint of its own beside `checkpoint`; `callback`
    receives the model of the stage. Other arguments are those of `xavatar_jax.fit`.

    **Raises:** `ValueError` for minutes that are not positive, or a body without limbs; otherwise
    as `xavatar_jax.fit`.
    """
    started = time.perf_counter()
    config = scanimate_quick() if config is None else config
    check_minutes(config.minutes)
    whole = known_body(frames, body)
    cut = body_only(whole)
    learned, _ = choose_frames(
        frames, train_frames=config.train_frames, minutes=config.minutes,
        per_minute=config.frames_per_minute,
    )  # fmt: skip
    learned_from = body_only_frames(cut, frames[learned])
    betas = subject_betas(frames)
    history = History(frames=len(learned))

    start = start_model(cut, betas, config, history=history, cache=cache, verbose=verbose)
    clock = time.perf_counter()
    with progress("scans", len(learned_from), verbose=verbose, unit="frame") as bar:
        scans = read_scans(
            cut, learned_from, betas, triangles=config.triangles, seed=config.seed, bar=bar
        )
    vertices = canonical_vertices(cut, jnp.asarray(betas, cut.template.dtype))
    template = Template(jnp.asarray(vertices, jnp.float32), jnp.asarray(cut.weights, jnp.float32))
    clock = history.lap("data", clock)

    digest = hashlib.sha256(np.asarray(scans.corners).tobytes()).hexdigest()
    parts = {
        "body": whole.source.checksum, "frames": frames_digest(learned_from.params, betas, [digest])
    }  # fmt: skip
    lines = None if log is None else JsonLines(log)
    left = 0.0 if config.minutes is None else started + 60 * config.minutes - clock
    end = clock

    def run(stage: Stage, model: Any, data: Any, steps: int, share: float) -> Any:
        nonlocal end
        if not steps:
            return model
        end += share * left
        deadline = None if config.minutes is None else end
        keeper = None
        if checkpoint is not None:
            path = Path(checkpoint).with_name(f"{Path(checkpoint).stem}-{stage.name}.npz")
            identity = Identity({**parts, "stage": stage.name}, config.to_dict(), _FREE)
            saved = None
            if resume and path.exists():
                saved = load_checkpoint(path, identity, ONE_DEVICE, history.notices)
            keeper = Keeper(path, identity, saved)
        own = History() if keeper is None or keeper.saved is None else keeper.saved.history()
        done = train(
            model, data, [stage], Schedule(steps, deadline, config.seed), history=own,
            keeper=keeper, log=lines, callback=callback, verbose=verbose, name=stage.name,
            options=config.to_dict(),
        )  # fmt: skip
        history.append(done.history)
        return done.model

    common: dict[str, Any] = {"clip": config.clip, "epsilon": config.start.optimiser.epsilon}
    nets = SkinNets(start.skinning, _inverse(cut, scans, config))
    for cycle, plan in ((False, config.skin), (True, config.cycle)):
        stage = skin_stage(
            plan, config.skin_weights, cycle=cycle, learn_forward=config.start.learn_skinning,
            **common,
        )  # fmt: skip
        nets = run(stage, nets, (scans, template), plan.steps, plan.share)
    clock = time.perf_counter()
    hands = static_hands(whole, frames.params, betas) if config.hands == "body" else None
    canonical = _canonical(nets, scans, hands, stretch=config.stretch, seed=config.seed)
    geometry = start.geometry.within(learned_from.params)
    if isinstance(geometry, LocalPoseMLP):  # it reads the learned weights from now on
        geometry = eqx.tree_at(lambda g: g.skinning, geometry, nets.forward)
    history.lap("canonical", clock)
    stage = shape_stage(
        config.shape, config.shape_weights, softness=config.start.losses.softness, **common
    )
    geometry = run(stage, geometry, (canonical, template), config.shape.steps, config.shape.share)
    history.lap("total", started)
    model = replace(start, skinning=nets.forward, geometry=geometry)
    avatar = Avatar(
        cut, betas, model, config.start.spec, steps=history.steps_done, method="scanimate",
        options=config.to_dict(),
    )  # fmt: skip
    return Fit(BodyOnlyAvatar(whole, avatar), history, None, learned_from)


def start_model(
    body: BodyModel,
    betas: Float[np.ndarray, " S"],
    config: ScanimateConfig,
    *,
    history: History | None = None,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
) -> AvatarModel:
    """Forward net and distance on a body-only skeleton, fitted to the body, laid on the person."""
    start, key = config.start, jax.random.key(config.seed)
    model = mean_shape_model(start.spec, body, key=key, betas=betas)
    key_forward, key_distance = jax.random.split(key)
    if config.forward is not None:
        forward = SoftmaxSkinning(body.tree, config.forward, key=key_forward)
        model = replace(model, skinning=forward)
    if config.distance is not None:
        distance = LocalPoseMLP(
            body.tree, model.skinning, config.distance, softness=start.losses.softness,
            key=key_distance,
        )  # fmt: skip
        model = replace(model, geometry=distance)
    _, model = starting_models(
        model, start, body, betas, seed=config.seed,
        history=History() if history is None else history, cache=cache, verbose=verbose,
    )  # fmt: skip
    return model


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
    *,
    stretch: float,
    seed: int,
) -> CanonicalScans:
    """All triangles by the inverse net, with those of `hands` instead of the scans' own hands.

    Triangles that are torn apart are replaced by others of their frame.
    """
    rng = np.random.default_rng((seed, 1))
    places = np.asarray(_carry(nets, scans)).reshape(scans.corners.shape)
    longer = edge_stretch(np.asarray(scans.corners), places)
    good = np.isfinite(longer) & (longer < stretch)
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
