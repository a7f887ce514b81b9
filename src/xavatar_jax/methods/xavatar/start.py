"""The model that training starts from: the body's mean shape, then the person's own."""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..._version import __version__
from ...body import BodyModel, BodyParams
from ...fields import (
    AvatarModel,
    ModelSpec,
    grid_vertices,
    lay_on_person,
    template_weights,
)
from ...files import cache_path, flatten_named, load_arrays, save_arrays, unflatten_named
from ...geometry import face_areas
from ...learning import FALLING, History, Schedule, Stage, notify, train
from ...sampling import signed_distance
from .config import FitConfig, LossConfig, OptimiserConfig
from .stages import LearnsParts, optimiser_of, weight_terms

_REVISION = 5  # raised when the fit below changes: it is part of the cache's key
_POINTS = 400_000
_SIGMA = (0.003, 0.01, 0.03)  # metres, of the points around the mean shape
_SURFACE_POINTS = 256  # a step of the weights: more teach a network less in the same time


class MeanShape(eqx.Module):
    """Points around the body's mean shape: signed distances and, for a network, the weights."""

    x_c: Float[Array, "N 3"]
    distance: Float[Array, " N"]
    weights: Float[Array, "N J"] | None
    params: BodyParams


class _Draw(eqx.Module):
    count: int = eqx.field(static=True)

    def __call__(self, model: Any, data: MeanShape, key: PRNGKeyArray) -> MeanShape:
        rows = jax.random.randint(key, (self.count,), 0, len(data.x_c))
        weights = None if data.weights is None else data.weights[rows]
        return MeanShape(data.x_c[rows], data.distance[rows], weights, data.params)


class _ShapeTerm(eqx.Module):
    def __call__(self, model: AvatarModel, batch: MeanShape, key: Any) -> Float[Array, ""]:
        condition = model.geometry.condition(batch.params)
        level = jax.vmap(lambda x: model.geometry(x, condition).level)(batch.x_c)
        return model.link.loss(level, batch.distance).mean()


class _TemplateTerm(eqx.Module):
    """Cross-entropy: unlike a squared error it still pulls where a weight is near zero."""

    def __call__(self, model: AvatarModel, batch: MeanShape, key: Any) -> Float[Array, ""]:
        assert batch.weights is not None
        found = jax.vmap(model.skinning)(batch.x_c)
        return -(batch.weights * jnp.log(found + 1e-6)).sum(-1).mean()


def fit_mean_shape(
    model: AvatarModel,
    spec: ModelSpec,
    body: BodyModel,
    *,
    steps: int,
    optimiser: OptimiserConfig,
    seed: int,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
) -> AvatarModel:
    """A model fitted to the mean shape of the body, kept in the cache folder.

    Geometry is always fitted; skinning, unless it has the template's weights already or is to
    start at random. The person's betas, correctives and frames play no part. `model` is what
    `mean_shape_model` gives for `seed`, possibly with other fields in it.
    """
    fits_skinning = not spec.skinning.knows_template and spec.skinning.start == "template"
    learns = LearnsParts(("skinning", "geometry") if fits_skinning else ("geometry",))
    arrays = eqx.filter(model, learns(model))
    options = (optimiser.learning_rate, optimiser.clip, optimiser.epsilon)
    key = json.dumps(
        [
            __version__, _REVISION, body.source.checksum, body.num_expression, spec.to_dict(),
            steps, options, seed, str(eqx.filter_eval_shape(lambda: arrays)),
        ]
    )  # fmt: skip
    name = hashlib.sha256(key.encode()).hexdigest()[:16]
    path = cache_path(cache) / f"mean-shape-{name}.npz"
    kept = _read_cached(path, arrays)
    if kept is not None:
        return eqx.combine(kept, model)
    terms: dict[str, Any] = {"occupancy": (1.0, _ShapeTerm())}
    if fits_skinning:
        terms["template"] = (1.0, _TemplateTerm())
    rates = replace(optimiser, skinning_rate=optimiser.learning_rate, warmup=0)
    draw = _Draw(model.geometry.batch_points // 2)
    stage = Stage("mean_shape", draw, terms, optimiser_of(rates), learns, FALLING)
    data = _mean_shape_points(body, seed, with_weights=fits_skinning)
    done = train(
        model, data, [stage], Schedule(steps, seed=seed), verbose=verbose, name="mean shape"
    )
    try:
        kept = flatten_named(eqx.filter(done.model, learns(model)))
        save_arrays(path, kept, {"kind": "mean shape"})
    except OSError as error:
        notify(
            f"the model fitted to the mean shape was not cached ({error}); the next run fits it "
            "again. Choose another folder with cache=FOLDER or --cache-dir.",
            None,
            stacklevel=2,
        )
    return done.model


def _read_cached(path: Any, like: Any) -> Any:
    """The cached arrays, or None if there are none or they cannot be used."""
    if not path.exists():
        return None
    try:
        saved, _ = load_arrays(path)
        kept = unflatten_named(like, saved, source=str(path))
        if all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(kept)):
            return kept
        reason = f"{path}: values that are not finite"
    except ValueError as error:
        reason = str(error)
    notify(f"{reason}. The fit to the mean shape is repeated.", None, stacklevel=3)
    return None


def _mean_shape_points(body: BodyModel, seed: int, *, with_weights: bool) -> MeanShape:
    rng = np.random.default_rng(seed)
    vertices, faces = grid_vertices(body), np.asarray(body.faces)
    labels: Int[np.ndarray, " F"] = np.asarray(body.part_labels)[faces[:, 0]]
    # Small parts get more than their area's share.
    density = face_areas(vertices, faces) * body.parts.densities[labels]
    face = rng.choice(len(faces), _POINTS, p=density / density.sum())
    share = rng.dirichlet(np.ones(3), _POINTS)
    points = np.einsum("nc,ncd->nd", share, vertices[faces[face]])
    points += np.resize(_SIGMA, _POINTS)[:, None] * rng.standard_normal(points.shape)
    far = rng.uniform(vertices.min(0) - 0.2, vertices.max(0) + 0.2, (_POINTS // 20, 3))
    points = np.concatenate([points, far])
    distance = signed_distance(vertices, faces, points)
    weights = None
    if with_weights:
        weights = jnp.asarray(template_weights(body, vertices, points), jnp.float32)
    return MeanShape(
        jnp.asarray(points, jnp.float32),
        jnp.asarray(distance, jnp.float32),
        weights,
        BodyParams.zeros(body),
    )


class _NoBatch(eqx.Module):
    def __call__(self, model: Any, data: Any, key: Any) -> None:
        return None


def fit_weights(
    model: AvatarModel,
    body: BodyModel,
    betas: Float[np.ndarray, " S"],
    *,
    steps: int,
    losses: LossConfig,
    optimiser: OptimiserConfig,
    seed: int,
    verbose: bool = False,
) -> AvatarModel:
    """A model whose skinning field was fitted to its own terms, before any root is searched.

    A step without a search costs a hundredth of one with it, and searches on meaningless weights
    find roots that spoil the geometry.
    """
    losses = replace(losses, surface_points=_SURFACE_POINTS)
    rates = replace(optimiser, skinning_rate=optimiser.learning_rate, warmup=0)
    terms = weight_terms(body, jnp.asarray(betas), losses)
    stage = Stage(
        "weights", _NoBatch(), terms, optimiser_of(rates), LearnsParts(("skinning",)), FALLING
    )
    schedule = Schedule(steps, seed=seed)
    return train(model, None, [stage], schedule, verbose=verbose, name="weights").model


def starting_models(
    model: AvatarModel,
    config: FitConfig,
    body: BodyModel,
    betas: Float[np.ndarray, " S"],
    *,
    seed: int,
    history: History,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
) -> tuple[AvatarModel, AvatarModel]:
    """The model at step 0, fitted to the mean shape, and the one for the person.

    `model` is as for `fit_mean_shape`.
    """
    clock, spec = time.perf_counter(), config.spec
    initial = fit_mean_shape(
        model, spec, body, steps=config.prefit_steps, optimiser=config.optimiser, seed=seed,
        cache=cache, verbose=verbose,
    )  # fmt: skip
    clock = history.lap("prefit", clock)
    start = lay_on_person(initial, spec, body, betas, key=jax.random.key(seed))
    if config.learn_skinning and config.weights_steps and not spec.skinning.knows_template:
        start = fit_weights(
            start, body, betas, steps=config.weights_steps, losses=config.losses,
            optimiser=config.optimiser, seed=seed, verbose=verbose,
        )  # fmt: skip
    history.lap("weights", clock)
    return initial, start
