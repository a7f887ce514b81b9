"""First fields from the body's mean shape: no download, nothing of the person to be learned."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from .._version import __version__
from ..body import FACES, HANDS, BodyModel, BodyParams
from ..fields import grid_vertices, template_weights
from ..files import cache_path, flatten_named, load_arrays, save_arrays, unflatten_named
from ..geometry import face_areas
from ..losses import binary_cross_entropy, soft_occupancy
from ..sampling import signed_distance
from .check import notify
from .config import FitConfig
from .model import AvatarFields, fresh_fields, trainable_geometry, trainable_skinning
from .progress import progress

_REVISION = 3  # raised when the fit below changes: it keys the cache
_POINTS = 400_000
_BATCH, _NETWORK_BATCH = 8192, 2048  # a network costs a hundred times more a point


def initial_fields(
    body: BodyModel,
    config: FitConfig,
    *,
    cache: str | os.PathLike[str] | None = None,
    verbose: bool = True,
    fields: AvatarFields | None = None,
) -> AvatarFields:
    """Fields fitted to the mean shape of the body; kept in the cache folder, one a body and config.

    The person's betas, correctives and frames play no part in it. `fields` are of other classes
    than those of the config, drawn by its seed.
    """
    own = [] if fields is None else [str(eqx.filter_eval_shape(lambda: fields))]
    fields = fresh_fields(body, config) if fields is None else fields
    fingerprint = json.dumps(
        [
            *own,
            __version__,
            _REVISION,
            body.source.checksum,
            body.num_expression,
            asdict(config.skinning),
            asdict(config.geometry),
            config.prefit_steps,
            config.losses.softness,
            [getattr(config.optimiser, name) for name in ("learning_rate", "clip", "epsilon")],
            config.seed,
        ]
    )
    name = hashlib.sha256(fingerprint.encode()).hexdigest()[:16]
    path = cache_path(cache) / f"prefit-{config.preset}-{name}.npz"
    # The template's grids are made anew: only what the fit changes is kept.
    arrays = eqx.filter(fields, _prefit_filter(fields, config))
    if path.exists():
        saved, _ = load_arrays(path)
        return eqx.combine(unflatten_named(arrays, saved, source=str(path)), fields)
    fields = _fit_mean_shape(body, fields, config, verbose=verbose)
    kept = eqx.filter(fields, _prefit_filter(fields, config))
    try:
        save_arrays(path, flatten_named(kept), {"kind": "prefit"})
    except OSError as error:
        notify(
            f"the fields fitted to the mean shape are not kept ({error}): the next run fits them "
            "again. Another folder may be given: cache=FOLDER, or --cache-dir.",
            None,
            stacklevel=2,
        )
    return fields


def _fit_mean_shape(
    body: BodyModel, fields: AvatarFields, config: FitConfig, *, verbose: bool
) -> AvatarFields:
    points, distance, weights = _mean_shape_points(body, config)
    params = BodyParams.zeros(body)
    learned, fixed = eqx.partition(fields, _prefit_filter(fields, config))
    fixed_arrays, static = eqx.partition(fixed, eqx.is_array)
    state = _optimiser(config).init(eqx.filter(learned, eqx.is_inexact_array))
    constant = (points, distance, weights, params, fixed_arrays)
    with progress("mean shape", config.prefit_steps, verbose=verbose) as bar:
        for k in range(config.prefit_steps):
            learned, state, value = _step(learned, state, jnp.asarray(k), constant, static, config)
            if k % 25 == 0:
                bar.set_postfix(loss=f"{float(value):.4f}")
            bar.update(1)
    return eqx.combine(learned, fixed)


def _optimiser(config: FitConfig) -> optax.GradientTransformation:
    rate = optax.cosine_decay_schedule(
        config.optimiser.learning_rate, max(config.prefit_steps, 1), alpha=0.05
    )
    return optax.chain(
        optax.clip_by_global_norm(config.optimiser.clip),
        optax.adam(rate, eps=config.optimiser.epsilon),
    )


@eqx.filter_jit
def _step(
    learned: Any, state: Any, k: Array, constant: Any, static: Any, config: FitConfig
) -> tuple[Any, Any, Array]:
    points, distance, weights, params, fixed_arrays = constant
    network = "mlp" in (config.skinning.kind, config.geometry.kind)
    batch = _NETWORK_BATCH if network else _BATCH
    key = jax.random.fold_in(jax.random.key(config.seed), k)
    rows = jax.random.randint(key, (batch,), 0, len(points))

    def loss(learned: AvatarFields) -> Array:
        fields = eqx.combine(learned, fixed_arrays, static)
        condition = fields.geometry.condition(params)
        logit = jax.vmap(lambda x: fields.geometry(x, condition))(points[rows])
        target = soft_occupancy(distance[rows], config.losses.softness)
        total = binary_cross_entropy(logit, target).mean()
        if weights is not None:
            found = jax.vmap(fields.skinning)(points[rows])
            # Cross-entropy: unlike a squared error it still pulls where a weight is near zero.
            total = total - (weights[rows] * jnp.log(found + 1e-6)).sum(-1).mean()
        return total

    value, gradient = jax.value_and_grad(loss)(learned)
    updates, state = _optimiser(config).update(gradient, state, learned)
    return eqx.apply_updates(learned, updates), state, value


def _prefit_filter(fields: AvatarFields, config: FitConfig) -> AvatarFields:
    """Geometry always; skinning where it is a network (a grid already holds the template), and
    where it does not start at random."""
    skinning = trainable_skinning(fields.skinning, learned=_fits_skinning(config))
    return AvatarFields(skinning, trainable_geometry(fields.geometry))


def _fits_skinning(config: FitConfig) -> bool:
    return config.skinning.kind != "grid" and config.skinning.start == "template"


def _mean_shape_points(body: BodyModel, config: FitConfig) -> tuple[Array, Array, Array | None]:
    """Points around the mean shape, signed distances, and template weights for a network."""
    rng = np.random.default_rng(config.seed)
    vertices, faces = grid_vertices(body), np.asarray(body.faces)
    labels = np.asarray(body.part_labels)[faces[:, 0]]
    density = face_areas(vertices, faces)
    # Small parts get more than their area's share.
    density[np.isin(labels, HANDS)] *= 8
    density[np.isin(labels, FACES)] *= 5
    face = rng.choice(len(faces), _POINTS, p=density / density.sum())
    share = rng.dirichlet(np.ones(3), _POINTS)
    points = np.einsum("nc,ncd->nd", share, vertices[faces[face]])
    sigma = np.resize([0.003, 0.01, 0.03], _POINTS)[:, None]
    points += sigma * rng.standard_normal(points.shape)
    far = rng.uniform(vertices.min(0) - 0.2, vertices.max(0) + 0.2, (_POINTS // 20, 3))
    points = np.concatenate([points, far])
    distance = signed_distance(vertices, faces, points)
    weights = None
    if _fits_skinning(config):
        weights = jnp.asarray(template_weights(body, vertices, points), jnp.float32)
    return jnp.asarray(points, jnp.float32), jnp.asarray(distance, jnp.float32), weights
