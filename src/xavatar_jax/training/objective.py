"""The training objective: occupancy at chosen roots, and the regularisers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ..body import FACE, HANDS, BodyModel, canonical_joints, canonical_vertices
from ..correspondence import Broyden, implicit_root, search_field, start_table
from ..fields import AbstractSkinningField, TabulatedSkinning, pose_grid
from ..kinematics import KinematicTree
from ..losses import binary_cross_entropy, soft_occupancy, squared_error
from ..sampling import bone_points, joint_targets
from .batch import Batch
from .config import FitConfig
from .devices import ONE_DEVICE, Devices
from .model import AvatarFields


class Anchors(eqx.Module):
    """What the regularisers know of the person's canonical body.

    - `joints`: `(J, 3)`; `surface`: `(S, 3)` vertices and their template weights `(S, J)`.
    """

    joints: Float[Array, "J 3"]
    surface: Float[Array, "S 3"]
    weights: Float[Array, "S J"]
    tree: KinematicTree = eqx.field(static=True)


def make_anchors(body: BodyModel, betas: Float[Array, " S"], config: FitConfig) -> Anchors:
    """Canonical joints and vertices of the person's shape."""
    labels = np.asarray(body.part_labels)
    chosen = np.arange(len(labels))
    if config.losses.surface_parts == "hands_face":
        chosen = np.flatnonzero(np.isin(labels, (*HANDS, FACE)))
        chosen = chosen if len(chosen) else np.arange(len(labels))
    vertices = canonical_vertices(body, betas)
    return Anchors(
        jnp.asarray(canonical_joints(body, betas), jnp.float32),
        jnp.asarray(vertices[chosen], jnp.float32),
        jnp.asarray(body.weights[chosen], jnp.float32),
        body.tree,
    )


Terms = dict[str, Float[Array, ""]]
Term = Callable[[AvatarFields, Batch, PRNGKeyArray], Float[Array, ""]]
"""A loss term of one's own: `term(fields, batch, key)`, a number differentiable in the fields."""
ExtraTerms = Mapping[str, tuple[float, Term]]
"""Loss terms of one's own by name, each with its weight."""
_OWN_TERMS = ("loss", "gradient", "occupancy", "bone", "joint", "surface", "found", "validation")


def check_terms(terms: ExtraTerms) -> None:
    """**Raises:** `ValueError` for a name that the library's own terms or the log use."""
    taken = [name for name in terms if name.removeprefix("skinning_") in _OWN_TERMS]
    if taken:
        raise ValueError(f"a term cannot be named {taken[0]!r}: the log has one of that name")


def with_extra(
    objective: Callable[..., tuple[Float[Array, ""], Terms]], terms: ExtraTerms, prefix: str
) -> Callable[..., tuple[Float[Array, ""], Terms]]:
    """The objective plus terms of one's own; in its record they have a prefix."""

    def both(
        fields: AvatarFields, batch: Batch, anchors: Anchors, config: FitConfig, key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], Terms]:
        total, known = objective(fields, batch, anchors, config, key)
        for k, (name, (weight, term)) in enumerate(terms.items()):
            value = term(fields, batch, jax.random.fold_in(key, k))
            total, known = total + weight * value, {**known, f"{prefix}{name}": value}
        return total, known

    return both if terms else objective


def geometry_objective(
    fields: AvatarFields, batch: Batch, anchors: Anchors, config: FitConfig, key: PRNGKeyArray
) -> tuple[Float[Array, ""], Terms]:
    """Occupancy at stored roots and along the bones: what geometry alone can lower."""
    conditions = jax.vmap(fields.geometry.condition)(batch.params)
    chosen = jax.vmap(_best_stored, in_axes=(None, 0, 0, 0, 0))(
        fields, batch.root, batch.others, batch.others_valid, conditions
    )
    logit = jax.vmap(jax.vmap(fields.geometry, in_axes=(0, None)))(chosen, conditions)
    terms = {
        "occupancy": jnp.where(
            batch.rooted, _divergence(logit, batch.distance, config), 0.0
        ).mean(),
        "bone": _bone_term(fields, anchors, conditions, key),
    }
    return weighted(terms, config), terms


def skinning_objective(
    fields: AvatarFields, batch: Batch, anchors: Anchors, config: FitConfig, key: PRNGKeyArray
) -> tuple[Float[Array, ""], Terms]:
    """Occupancy through the implicit derivative of stored roots, and the holds on the weights."""
    conditions = jax.vmap(fields.geometry.condition)(batch.params)
    chosen = jax.vmap(_best_stored, in_axes=(None, 0, 0, 0, 0))(
        fields, batch.root, batch.others, batch.others_valid, conditions
    )
    logit, regular = _logit_through_root(fields, chosen, batch, conditions)
    use = regular & batch.rooted
    entropy = jnp.where(use, _divergence(logit, batch.distance, config), 0.0)
    terms = {
        "occupancy": entropy.sum() / jnp.maximum(use.sum(), 1),
        **weight_terms(fields.skinning, anchors, config, key),
    }
    return weighted(terms, config), {f"skinning_{name}": term for name, term in terms.items()}


def full_objective(
    fields: AvatarFields,
    batch: Batch,
    anchors: Anchors,
    config: FitConfig,
    key: PRNGKeyArray,
    *,
    guide: TabulatedSkinning | None = None,
    devices: Devices = ONE_DEVICE,
) -> tuple[Float[Array, ""], Terms]:
    """All terms, with roots searched on the fields themselves (X-Avatar, eq. 9 to 12)."""
    conditions = jax.vmap(fields.geometry.condition)(batch.params)
    roots, valid = devices.apart(
        lambda known, batch: search_batch(known[0], known[1], batch, config, anchors.tree),
        (fields.skinning, guide),
        batch,
    )
    chosen, found = jax.vmap(best_root, in_axes=(None, 0, 0, 0))(fields, roots, valid, conditions)
    logit, regular = _logit_through_root(fields, chosen, batch, conditions)
    use = found & regular
    entropy = jnp.where(use, _divergence(logit, batch.distance, config), 0.0)
    bone_key, surface_key = jax.random.split(key)
    terms = {
        "occupancy": entropy.sum() / jnp.maximum(use.sum(), 1),
        "bone": _bone_term(fields, anchors, conditions, bone_key),
        **weight_terms(fields.skinning, anchors, config, surface_key),
    }
    return weighted(terms, config), {**terms, "found": found.mean()}


def weighted(terms: Terms, config: FitConfig) -> Float[Array, ""]:
    """The sum of terms, each with its weight in the config."""
    losses = config.losses
    weights = {
        "occupancy": 1.0,
        "bone": losses.bone,
        "joint": losses.joint,
        "surface": losses.surface,
    }
    return jnp.asarray(sum(weights[name] * term for name, term in terms.items()))


def _divergence(
    logit: Float[Array, "*n"], distance: Float[Array, "*n"], config: FitConfig
) -> Float[Array, "*n"]:
    """Cross-entropy less the target's own entropy, so that a perfect field has zero."""
    softness = config.losses.softness
    target = soft_occupancy(distance, softness)
    entropy = binary_cross_entropy(logit, target)
    if softness == 0:
        return entropy
    return entropy - binary_cross_entropy(distance / softness, target)


def _bone_term(
    fields: AvatarFields, anchors: Anchors, conditions: Any, key: PRNGKeyArray
) -> Float[Array, ""]:
    """Points on the bones are inside."""
    first = jax.tree.map(lambda leaf: leaf[0], conditions)
    inside = bone_points(anchors.tree, anchors.joints, key)
    logit = jax.vmap(lambda x: fields.geometry(x, first))(inside)
    return binary_cross_entropy(logit, jnp.ones_like(logit)).mean()


def weight_terms(
    skinning: AbstractSkinningField, anchors: Anchors, config: FitConfig, key: PRNGKeyArray
) -> Terms:
    """At a joint its two bones share; at the body's surface the template's weights hold."""
    where, hot = joint_targets(anchors.tree)
    at_joints = jax.vmap(skinning)(anchors.joints)
    surface, wanted = anchors.surface, anchors.weights
    if config.losses.surface_points:
        pick = jax.random.randint(key, (config.losses.surface_points,), 0, len(surface))
        surface, wanted = surface[pick], wanted[pick]
    return {
        "joint": squared_error(at_joints[where], jnp.asarray(hot)).mean(),
        "surface": squared_error(jax.vmap(skinning)(surface), wanted).mean(),
    }


def _logit_through_root(
    fields: AvatarFields, chosen: Float[Array, "B M 3"], batch: Batch, conditions: Any
) -> tuple[Float[Array, "B M"], Bool[Array, "B M"]]:
    """Logits at polished roots, differentiable in the skinning field, and where that is so."""

    def logit(x_c: Array, x_d: Array, transforms: Array, condition: Any) -> tuple[Array, Array]:
        polished, _, regular = implicit_root(x_c, x_d, fields.skinning, transforms)
        return fields.geometry(polished, condition), regular

    over_points = jax.vmap(logit, in_axes=(0, 0, None, None))
    return jax.vmap(over_points)(chosen, batch.points, batch.transforms, conditions)


def best_root(
    fields: AvatarFields,
    roots: Float[Array, "M K 3"],
    valid: Bool[Array, "M K"],
    condition: Any,
) -> tuple[Float[Array, "M 3"], Bool[Array, " M"]]:
    """Of K roots of each point the one with the largest logit, and whether there is one.

    Source: X-Avatar, section 3.3. Which root it is has no derivative.
    """
    geometry, condition = jax.lax.stop_gradient((fields.geometry, condition))
    logits = jax.vmap(jax.vmap(lambda x: geometry(x, condition)))(roots)
    best = jnp.argmax(jnp.where(valid, logits, -jnp.inf), axis=-1)
    chosen = jnp.take_along_axis(roots, best[:, None, None], axis=1)[:, 0]
    found = jnp.any(valid, axis=-1)
    # A point without a root stands at the origin: finite, and masked.
    return jnp.where(found[:, None], chosen, 0.0), found


def _best_stored(
    fields: AvatarFields,
    root: Float[Array, "M 3"],
    others: Float[Array, "Q K 3"],
    others_valid: Bool[Array, "Q K"],
    condition: Any,
) -> Float[Array, "M 3"]:
    """The same for stored roots, asking the field only about points that have several."""
    rows = others.shape[0]
    if not rows or not others.shape[1]:
        return root
    roots = jnp.concatenate([root[:rows, None], others], axis=1)
    valid = jnp.concatenate([jnp.ones((rows, 1), bool), others_valid], axis=1)
    best, _ = best_root(fields, roots, valid, condition)
    return jnp.concatenate([best, root[rows:]])


def search_batch(
    skinning: AbstractSkinningField,
    guide: TabulatedSkinning | None,
    batch: Batch,
    config: FitConfig,
    tree: KinematicTree,
) -> tuple[Float[Array, "B M K 3"], Bool[Array, "B M K"]]:
    """Roots of every point, searched inside the training step: the field's own, guide or not."""
    starts = start_table(tree, config.search.starts)
    skinning = jax.lax.stop_gradient(skinning)
    solver = Broyden(atol=config.search.atol, divergence=1.0)
    keep = min(config.search.keep, starts.width)

    def one_frame(frame: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        found = search_field(
            skinning,
            *frame,
            starts,
            guide=None if guide is None else pose_grid(guide, frame[-1]),
            solver=solver,
            keep=keep,
            max_steps=config.search.max_steps,
        )
        return found.x_c, found.valid

    # One frame after another: the loops inside end when that frame's lanes do.
    return jax.lax.map(one_frame, (batch.points, batch.parts, batch.transforms))
