"""The fields of one avatar, and which of their arrays are learned."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import FACES, LEFT_HAND, RIGHT_HAND, BodyModel, canonical_joints
from ..body.params import MAX_DEFAULT_COEFFICIENTS
from ..fields import (
    AbstractGeometryField,
    AbstractSkinningField,
    ExpressionGrid,
    GridSkinning,
    HashGeometry,
    MLPGeometry,
    MLPSkinning,
    grid_vertices,
    random_grid_skinning,
    template_expression,
    template_grid_skinning,
)
from .config import FitConfig, GeometryConfig, SkinningConfig

# Metres around hands and face where there is detail: of the mean shape, so that one start serves
# most people, and of the person, so that it serves all.
_DETAIL_MARGIN, _OWN_MARGIN = 0.1, 0.04


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
        skinning = _grids(body, grid_vertices(body), config.skinning, key_skinning)
    else:
        skinning = _person_grids(body, betas, config)
    return AvatarFields(skinning, _geometry(body, config.geometry, key_geometry, betas))


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
    return _grids(body, grid_vertices(body, betas), config.skinning, _keys(config)[0])


def _moves_grids(config: FitConfig) -> bool:
    return config.losses.surface > 0 or config.skinning.start == "random"


def _geometry(
    body: BodyModel, config: GeometryConfig, key: Array, betas: Any = None
) -> AbstractGeometryField:
    """A geometry field for the mean shape, or for a person.

    Of grids, a person has joints around which rotations act, places that the body model's
    expression moves, and boxes of detail that reach around their own hands and face.
    """
    expression = min(body.num_expression, MAX_DEFAULT_COEFFICIENTS)
    if config.kind == "mlp":
        return MLPGeometry(body.tree, expression, config.mlp, key=key)
    mean = grid_vertices(body)
    own = None if betas is None else grid_vertices(body, betas)
    detail, face = _detail(body, config, mean, own)
    expressive = None
    if expression and face is not None:
        expressive = ExpressionGrid(
            *face,
            spacing=config.expression_spacing,
            num_expression=expression,
            features=config.expression_features,
        )
    geometry = HashGeometry(
        body.tree,
        np.asarray(canonical_joints(body, jnp.zeros(0, body.template.dtype))),
        expressive,
        mean.min(0) - config.box_margin,
        mean.max(0) + config.box_margin,
        spacing=config.spacing,
        trunk_spacing=config.trunk,
        detail=detail,
        features=config.features,
        log2_size=config.log2_size,
        width=config.width,
        condition_width=config.condition,
        sharpness=config.sharpness,
        key=key,
    )
    if own is None:
        return geometry
    joints = canonical_joints(body, jnp.asarray(betas, body.template.dtype))
    moves = None
    if config.expression_moves:
        known = geometry.expression_range.shape[1]
        moves = template_expression(body, own, config.expression_moves, known)
    return eqx.tree_at(
        lambda g: (g.joints, g.moves),
        geometry,
        (jnp.asarray(joints, jnp.float32), moves),
        is_leaf=lambda x: x is None,
    )


_Box = tuple[np.ndarray, np.ndarray]


def _detail(
    body: BodyModel,
    config: GeometryConfig,
    mean: Float[np.ndarray, "V 3"],
    own: Float[np.ndarray, "V 3"] | None,
) -> tuple[tuple[tuple[np.ndarray, np.ndarray, float], ...], _Box | None]:
    """Boxes of detail, each with the spacing in it, and the one of the face, if there is a face."""
    labels = np.asarray(body.part_labels)
    detail, face = [], None
    for members, spacing in (
        ((LEFT_HAND,), config.hands),
        ((RIGHT_HAND,), config.hands),
        (FACES, config.face),
    ):
        rows = np.isin(labels, members)
        if not rows.any():
            continue
        low, high = mean[rows].min(0) - _DETAIL_MARGIN, mean[rows].max(0) + _DETAIL_MARGIN
        if own is not None:
            low = np.minimum(low, own[rows].min(0) - _OWN_MARGIN)
            high = np.maximum(high, own[rows].max(0) + _OWN_MARGIN)
        detail.append((low, high, spacing))
        if members == FACES:
            face = low, high
    return tuple(detail), face


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
    skinning, geometry = fields.skinning, fields.geometry
    if isinstance(skinning, GridSkinning) and _moves_grids(config):
        skinning = _person_grids(body, betas, config)
    if isinstance(geometry, HashGeometry):
        own = _geometry(body, config.geometry, _keys(config)[1], betas)
        # What the fit to the mean shape has changed: it knows no pose and no expression.
        geometry = eqx.tree_at(_shape_leaves, own, _shape_leaves(geometry))
    return AvatarFields(skinning, geometry)


def _shape_leaves(geometry: Any) -> Any:
    return geometry.encoding, geometry.hidden, geometry.biases


def trainable_filter(fields: AvatarFields, config: FitConfig) -> AvatarFields:
    """A tree of booleans: which leaves are learned. Template arrays and grids never are."""
    skinning = trainable_skinning(fields.skinning, learned=config.skinning.learned)
    return AvatarFields(skinning, trainable_geometry(fields.geometry))


def trainable_skinning(
    skinning: AbstractSkinningField, *, learned: bool = True
) -> AbstractSkinningField:
    """Of skinning grids the correction, of others every floating-point leaf; or none."""
    if isinstance(skinning, GridSkinning):
        frozen = jax.tree.map(lambda _: False, skinning)
        return eqx.tree_at(lambda s: s.correction, frozen, learned)
    return jax.tree.map(lambda leaf: learned and eqx.is_inexact_array(leaf), skinning)


def trainable_geometry(geometry: AbstractGeometryField) -> AbstractGeometryField:
    """Every floating-point leaf but the `fixed_leaves` and the `moves` of a hash-grid field."""
    learned = jax.tree.map(eqx.is_inexact_array, geometry)
    if isinstance(geometry, HashGeometry):
        fixed = lambda g: (*g.fixed_leaves, *jax.tree.leaves(g.moves))  # noqa: E731
        learned = eqx.tree_at(fixed, learned, replace_fn=lambda _: False)
    return learned
