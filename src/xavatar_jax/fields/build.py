"""Building a model from its spec and a body, for the mean shape or for a person."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..body import BodyModel, canonical_joints
from ..body.params import MAX_DEFAULT_COEFFICIENTS
from .feature_grids import ExpressionGrid
from .geometry import AbstractGeometryField, MLPGeometry
from .grids import GridSpacing, PartGrids
from .hash_geometry import HashGeometry
from .link import AbstractLink, Occupancy, SignedDistance
from .model import AvatarModel
from .skinning import AbstractSkinningField, MLPSkinning
from .spec import GeometrySpec, LinkSpec, ModelSpec, SkinningSpec
from .template import (
    body_part_grids,
    grid_vertices,
    random_grid_skinning,
    template_expression,
    template_grid_skinning,
)

# How far the boxes of detail reach beyond hands and face, metres: those of the mean shape, so that
# one start serves most people, and the person's own.
_DETAIL_MARGIN, _OWN_MARGIN = 0.1, 0.04
_Betas = Float[Array | np.ndarray, " S"]


def build_model(
    spec: ModelSpec, body: BodyModel, *, key: PRNGKeyArray, betas: _Betas | None = None
) -> AvatarModel:
    """A model before any fit: a function of spec, body and key.

    It is laid out for the body's mean shape, or for the person of `betas`.
    """
    return _model(spec, body, key, betas, betas)


def mean_shape_model(
    spec: ModelSpec, body: BodyModel, *, key: PRNGKeyArray, betas: _Betas
) -> AvatarModel:
    """A person's model whose geometry is laid out for the body's mean shape, to be fitted there.

    `lay_on_person` then makes it what `build_model` gives, but for what was fitted.
    """
    return _model(spec, body, key, betas, None)


def _model(
    spec: ModelSpec,
    body: BodyModel,
    key: PRNGKeyArray,
    skinning_betas: _Betas | None,
    geometry_betas: _Betas | None,
) -> AvatarModel:
    key_skinning, key_geometry = jax.random.split(key)
    return AvatarModel(
        _skinning(body, spec.skinning, key_skinning, skinning_betas),
        _geometry(body, spec.geometry, key_geometry, geometry_betas),
        build_link(spec.link),
    )


def lay_on_person(
    model: AvatarModel, spec: ModelSpec, body: BodyModel, betas: _Betas, *, key: PRNGKeyArray
) -> AvatarModel:
    """A model whose geometry was fitted to the mean shape, laid out for a person instead.

    Feature grids keep what they learned, and get the person's joints, detail boxes and expression.
    Other fields come back unchanged. `key` is that of `mean_shape_model`.
    """
    _, key_geometry = jax.random.split(key)
    geometry = model.geometry
    if isinstance(geometry, HashGeometry):
        own = _geometry(body, spec.geometry, key_geometry, betas)
        # The mean shape teaches no pose and no expression: only these have changed.
        fitted = lambda g: (g.encoding, g.hidden, g.biases)  # noqa: E731
        geometry = eqx.tree_at(fitted, own, fitted(geometry))
    return AvatarModel(model.skinning, geometry, model.link, model.color)


def build_link(spec: LinkSpec) -> AbstractLink:
    """The link that a spec describes."""
    kinds = {"occupancy": Occupancy, "signed_distance": SignedDistance}
    return kinds[spec.kind](spec.softness)


def grids_for_search(
    skinning: AbstractSkinningField, body: BodyModel, betas: _Betas, spacing: GridSpacing
) -> PartGrids:
    """Grids on which to tabulate a skinning field: its own, or new ones around the person."""
    own = getattr(skinning, "grids", None)
    if isinstance(own, PartGrids):
        return own
    return body_part_grids(body, grid_vertices(body, betas), spacing)


def _skinning(
    body: BodyModel, spec: SkinningSpec, key: PRNGKeyArray, betas: _Betas | None
) -> AbstractSkinningField:
    if spec.kind == "mlp":
        return MLPSkinning(body.tree, spec.mlp, key=key)
    vertices = grid_vertices(body, betas if spec.around == "person" else None)
    if spec.start == "random":
        return random_grid_skinning(body, vertices, spec.grid, spec.correction, key=key)
    return template_grid_skinning(body, vertices, spec.grid, spec.correction)


def _geometry(
    body: BodyModel, spec: GeometrySpec, key: PRNGKeyArray, betas: _Betas | None
) -> AbstractGeometryField:
    expression = min(body.num_expression, MAX_DEFAULT_COEFFICIENTS)
    if spec.kind == "mlp":
        return MLPGeometry(body.tree, expression, spec.mlp, key=key)
    mean = grid_vertices(body)
    own = None if betas is None else grid_vertices(body, betas)
    detail, face = _detail(body, spec, mean, own)
    expressive = None
    if expression and face is not None:
        expressive = ExpressionGrid(
            *face,
            spacing=spec.expression_spacing,
            num_expression=expression,
            features=spec.expression_features,
        )
    geometry = HashGeometry(
        body.tree,
        np.asarray(canonical_joints(body, jnp.zeros(0, body.template.dtype))),
        expressive,
        mean.min(0) - spec.box_margin,
        mean.max(0) + spec.box_margin,
        spacing=spec.spacing,
        trunk_spacing=spec.trunk,
        detail=detail,
        features=spec.features,
        log2_size=spec.log2_size,
        width=spec.width,
        condition_width=spec.condition,
        sharpness=spec.sharpness,
        key=key,
    )
    if own is None:
        return geometry
    joints = canonical_joints(body, jnp.asarray(betas, body.template.dtype))
    moves = None
    if spec.expression_moves:
        known = geometry.expression_range.shape[1]
        moves = template_expression(body, own, spec.expression_moves, known)
    return eqx.tree_at(
        lambda g: (g.joints, g.moves),
        geometry,
        (jnp.asarray(joints, jnp.float32), moves),
        is_leaf=lambda x: x is None,
    )


_Box = tuple[np.ndarray, np.ndarray]


def _detail(
    body: BodyModel,
    spec: GeometrySpec,
    mean: Float[np.ndarray, "V 3"],
    own: Float[np.ndarray, "V 3"] | None,
) -> tuple[tuple[tuple[np.ndarray, np.ndarray, float], ...], _Box | None]:
    """Boxes of detail, each with the spacing in it, and the face's, if there is a face."""
    detail, face = [], None
    for name, region, _ in body.parts.pieces:
        rows = body.parts.mask(name)
        if not rows.any():
            continue
        low, high = mean[rows].min(0) - _DETAIL_MARGIN, mean[rows].max(0) + _DETAIL_MARGIN
        if own is not None:
            low = np.minimum(low, own[rows].min(0) - _OWN_MARGIN)
            high = np.maximum(high, own[rows].max(0) + _OWN_MARGIN)
        detail.append((low, high, getattr(spec, region)))
        if region == "face":
            face = low, high
    return tuple(detail), face
