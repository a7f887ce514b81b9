"""The first act of training: skinning weights for the person's own canonical body."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import BodyModel
from ..fields import GridSkinning
from .config import FitConfig, for_programs
from .model import AvatarFields, lay_on_person, trainable_skinning
from .objective import Anchors, make_anchors, weight_terms, weighted
from .progress import progress
from .step import cosine, make_optimiser

_POINTS = 256  # of the surface, a step: more of them teach a network less in the same time


def settle_on_person(
    body: BodyModel,
    fields: AvatarFields,
    betas: Float[np.ndarray, " S"],
    config: FitConfig,
    *,
    verbose: bool = False,
) -> AvatarFields:
    """Fields that know the person's joints and surface, as far as the terms on the weights tell.

    Grids over a template find that in one go (`lay_on_person`). A network, or grids that start at
    random, take `config.settle_steps` of gradient descent on these terms alone: a step without a
    search costs a hundredth of one with it, and searches on weights that mean nothing find roots
    that spoil the geometry.
    """
    fields = lay_on_person(body, fields, betas, config)
    at_once = isinstance(fields.skinning, GridSkinning) and config.skinning.start == "template"
    if at_once or not config.skinning.learned or not config.settle_steps:
        return fields
    anchors = make_anchors(body, jnp.asarray(betas), config)
    learned, fixed = eqx.partition(fields.skinning, trainable_skinning(fields.skinning))
    fixed_arrays, static = eqx.partition(fixed, eqx.is_array)
    state = make_optimiser(config).init(learned)
    constant = (anchors, fixed_arrays)
    read = for_programs(replace(config, losses=replace(config.losses, surface_points=_POINTS)))
    with progress("weights", config.settle_steps, verbose=verbose, unit="step") as bar:
        for k in range(config.settle_steps):
            done = jnp.asarray(k / config.settle_steps)
            key = jax.random.fold_in(jax.random.key(config.seed), k)
            learned, state = _step(learned, state, constant, key, done, static, read)
            bar.update(1)
    return AvatarFields(eqx.combine(learned, fixed), fields.geometry)


@eqx.filter_jit
def _step(
    learned: Any,
    state: Any,
    constant: tuple[Anchors, Any],
    key: Array,
    done: Float[Array, ""],
    static: Any,
    config: FitConfig,
) -> tuple[Any, Any]:
    anchors, fixed_arrays = constant

    def loss(learned: Any) -> Float[Array, ""]:
        skinning = eqx.combine(learned, fixed_arrays, static)
        return weighted(weight_terms(skinning, anchors, config, key), config)

    updates, state = make_optimiser(config).update(jax.grad(loss)(learned), state, learned)
    rate = config.optimiser.learning_rate * cosine(done)
    return eqx.apply_updates(learned, jax.tree.map(lambda u: -rate * u, updates)), state
