"""The fields of one avatar, and which of their arrays are learned."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import FACES, LEFT_HAND, RIGHT_HAND, BodyModel, canonical_joints, canonical_vertices
from ..fields import (
    AbstractGeometryField,
    AbstractSkinningField,
    ExpressionGrid,
    GridSkinning,
    HashGeometry,
    MLPGeometry,
    MLPSkinning,
    mean_canonical_vertices,
    random_grid_skinning,
    template_expression,
    template_grid_skinning,
)
from .config import FitConfig, GeometryConfig, SkinningConfig

# Metres around the mean shape's hands and face where detail is heard: another person's hands are
# some centimetres away.
_DETAIL_MARGIN = 0.1


class AvatarFields(eqx.Module):
    """Skinning and geometry in one canonical space."""

    skinning: AbstractSkinningField
    geometry: AbstractGeometryField


def fresh_fields(
    body: BodyModel, config: FitConfig, betas: Float[np.ndarray, " S"] | None = None
) -> AvatarFields:
    """Fields before anything was fitted: a function of body, config and seed.

    They know the mean shape alone; with `betas`, as `lay_on_person` leaves them.
    """
    key_skinning, key_geometry = _keys(config)
    if config.skinning.kind == "mlp":
        skinning = MLPSkinning(body.tree, config.skinning.mlp, key=key_skinning)
    elif betas is None or not _moves_grids(config):
        skinning = _grids(body, mean_canonical_vertices(body), config.skinning, key_skinning)
    else:
        skinning = _person_grids(body, betas, config)
    geometry = _geometry(body, config.geometry, key_geometry)
    if betas is not None:
        geometry = _on_person(geometry, body, betas, config.geometry)
    return AvatarFields(skinning, geometry)


def _keys(config: FitConfig) -> Array:
    """Keys of the skinning and of the geometry."""
    return jax.random.split(jax.random.key(config.seed))


def _grids(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], config: SkinningConfig, key: Array
) -> GridSkinning:
    """A grid field around canonical vertices."""
    if config.start == "random":
        return random_grid_skinning(body, vertices, config.grid, config.correction, key=key)
    return template_grid_skinning(body, vertices, config.grid, config.correction)


def _person_grids(body: BodyModel, betas: Any, config: FitConfig) -> GridSkinning:
    vertices = canonical_vertices(body, jnp.asarray(betas, body.template.dtype))
    return _grids(body, np.asarray(vertices, np.float64), config.skinning, _keys(config)[0])


def _moves_grids(config: FitConfig) -> bool:
    return config.losses.surface > 0 or config.skinning.start == "random"


def _on_person(
    geometry: AbstractGeometryField, body: BodyModel, betas: Any, config: GeometryConfig
) -> AbstractGeometryField:
    """A field whose condition is heard around the person's own joints, and moves their own face."""
    if not isinstance(geometry, HashGeometry):
        return geometry
    betas = jnp.asarray(betas, body.template.dtype)
    joints = jnp.asarray(canonical_joints(body, betas), jnp.float32)
    moves = None
    if config.expression_moves:
        vertices = np.asarray(canonical_vertices(body, betas), np.float64)
        known = geometry.expression_range.shape[1]
        moves = template_expression(body, vertices, config.expression_moves, known)
    return eqx.tree_at(
        lambda g: (g.joints, g.moves), geometry, (joints, moves), is_leaf=lambda x: x is None
    )


def _geometry(body: BodyModel, config: GeometryConfig, key: Array) -> AbstractGeometryField:
    expression = min(body.num_expression, 10)
    if config.kind == "mlp":
        return MLPGeometry(body.tree, expression, config.mlp, key=key)
    vertices = mean_canonical_vertices(body)
    labels = np.asarray(body.part_labels)
    detail = []
    for members, spacing in (
        ((LEFT_HAND,), config.hands),
        ((RIGHT_HAND,), config.hands),
        (FACES, config.face),
    ):
        own = vertices[np.isin(labels, members)]
        if len(own):
            detail.append((own.min(0) - _DETAIL_MARGIN, own.max(0) + _DETAIL_MARGIN, spacing))
    expressive = None
    if expression and np.isin(labels, FACES).any():
        low, high, _ = detail[-1]
        expressive = ExpressionGrid(
            low,
            high,
            spacing=config.expression_spacing,
            num_expression=expression,
            features=config.expression_features,
        )
    return HashGeometry(
        body.tree,
        np.asarray(canonical_joints(body, jnp.zeros(0, body.template.dtype))),
        expressive,
        vertices.min(0) - config.box_margin,
        vertices.max(0) + config.box_margin,
        spacing=config.spacing,
        trunk_spacing=config.trunk,
        detail=tuple(detail),
        features=config.features,
        log2_size=config.log2_size,
        width=config.width,
        condition_width=config.condition,
        sharpness=config.sharpness,
        key=key,
    )


def lay_on_person(
    body: BodyModel, fields: AvatarFields, betas: Float[np.ndarray, " S"], config: FitConfig
) -> AvatarFields:
    """Grid fields around the person's own canonical body instead of the mean shape's.

    The surface term of the objective asks for the template's weights at the person's canonical
    vertices (X-Avatar, section 3.4, which takes the subject's mean shape there). On grids that
    has a direct solution, which gradient descent from the mean shape would take long to find
    where a hand lies some centimetres away. Networks come back as they are, and so do template
    weights where that term is off (ablation A4). Grids that start at random are only moved to the
    person, and know no weights of the template.
    """
    skinning = fields.skinning
    if isinstance(skinning, GridSkinning) and _moves_grids(config):
        skinning = _person_grids(body, betas, config)
    geometry = _on_person(fields.geometry, body, betas, config.geometry)
    return AvatarFields(skinning, geometry)


def trainable_filter(fields: AvatarFields, config: FitConfig) -> AvatarFields:
    """A tree of booleans: which leaves are learned. Template arrays and grids never are."""
    learned = jax.tree.map(eqx.is_inexact_array, fields)
    if isinstance(fields.skinning, GridSkinning):
        frozen = jax.tree.map(lambda _: False, fields.skinning)
        frozen = eqx.tree_at(lambda s: s.correction, frozen, config.skinning.learned)
        learned = eqx.tree_at(lambda f: f.skinning, learned, frozen)
    elif not config.skinning.learned:
        frozen = jax.tree.map(lambda _: False, fields.skinning)
        learned = eqx.tree_at(lambda f: f.skinning, learned, frozen)
    if isinstance(fields.geometry, HashGeometry):
        learned = eqx.tree_at(
            lambda f: (*f.geometry.told, *jax.tree.leaves(f.geometry.moves)),
            learned,
            replace_fn=lambda _: False,
        )
    return learned


def as_dtype(fields: AvatarFields, dtype: Any) -> AvatarFields:
    """The same fields with floating-point leaves of another type."""
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, dtype) if eqx.is_inexact_array(leaf) else leaf, fields
    )
