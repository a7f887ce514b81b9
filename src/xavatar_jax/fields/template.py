"""What the body's mean shape says of space: grids, weights on their nodes."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..body import (
    BodyModel,
    canonical_expression_dirs,
    canonical_vertices,
)
from ..geometry import closest_points
from .feature_grids import ExpressionGrid
from .grids import GridSpacing, PartGrids, build_part_grids
from .hierarchical import hierarchical_logits, num_logits
from .skinning import GridSkinning

# Around the face, where its expression is told: it fades out over half of this.
_FACE_MARGIN = 0.04


def grid_vertices(
    body: BodyModel, betas: Float[Array | np.ndarray, " S"] | None = None
) -> Float[np.ndarray, "V 3"]:
    """A shape, the mean one unless given, in the canonical pose, metres.

    In float64: grids are laid around it, and a learned array fits them on another machine only if
    not one cell is decided by a rounding.
    """
    with jax.enable_x64(True):
        betas = jnp.zeros(0) if betas is None else jnp.asarray(np.asarray(betas, np.float64))
        return np.asarray(_in_float64(body, betas))


@eqx.filter_jit
def _in_float64(body: BodyModel, betas: Float[Array, " S"]) -> Float[Array, "V 3"]:
    wide = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float64) if eqx.is_inexact_array(leaf) else leaf, body
    )
    return canonical_vertices(wide, betas)


def body_part_grids(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], spacing: GridSpacing
) -> PartGrids:
    """Grids around canonical vertices: coarse everywhere, fine at both hands and the face."""
    return build_part_grids(
        vertices,
        np.asarray(body.parts.labels),
        spacing,
        fine_parts={
            name: (labels, getattr(spacing, region)) for name, region, labels in body.parts.pieces
        },
    )


def template_weights(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N J"]:
    """The template's skinning weights, carried to points by the closest point of the surface.

    `vertices` are the body's in the canonical pose, of any shape.
    """
    return _from_surface(body, vertices, points) @ np.asarray(body.weights, np.float64)


def template_expression(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], spacing: float, num_expression: int
) -> ExpressionGrid | None:
    """How the body model's own expression moves canonical places of the face, metres.

    On nodes around the canonical `vertices` of the face, by the closest point of the surface.
    None for a body without a face, or without expression.
    """
    face = vertices[body.parts.mask("face")]
    if not len(face) or not num_expression:
        return None
    grid = ExpressionGrid(
        face.min(0) - _FACE_MARGIN,
        face.max(0) + _FACE_MARGIN,
        spacing=spacing,
        num_expression=num_expression,
        features=3,
    )
    moves = np.asarray(canonical_expression_dirs(body), np.float64)[..., :num_expression]
    moves = moves.transpose(0, 2, 1).reshape(len(vertices), -1)
    table = _from_surface(body, vertices, grid.nodes) @ moves
    return eqx.tree_at(
        lambda g: g.table, grid, jnp.asarray(table.reshape(grid.table.shape), jnp.float32)
    )


def _from_surface(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "N 3"]
) -> Any:
    """A sparse `(N, V)` that carries values at vertices to points, each from its closest place."""
    from scipy.sparse import csr_array

    faces = np.asarray(body.faces)
    _, face, position = closest_points(vertices, faces, points)
    corners = faces[face]
    share = _barycentric(position, vertices[corners])
    ends = np.arange(0, 3 * len(points) + 1, 3)
    return csr_array((share.ravel(), corners.ravel(), ends), (len(points), len(vertices)))


def template_grid_skinning(
    body: BodyModel,
    vertices: Float[np.ndarray, "V 3"],
    spacing: GridSpacing,
    correction_spacing: GridSpacing,
    *,
    smoothing_steps: int = 12,
) -> GridSkinning:
    """A body's own weights around its canonical `vertices` on part grids, without correction.

    Away from the surface the weights are smoothed over neighbouring nodes, so that the field has
    no jump where the closest point does (between fingers, between the legs).
    """
    grids = body_part_grids(body, vertices, spacing)
    nodes = np.asarray(grids.nodes, np.float64)
    weights = template_weights(body, vertices, nodes)
    weights = _smooth_away_from_surface(vertices, grids, weights, smoothing_steps)
    logits = hierarchical_logits(body.tree, weights)
    correction_grids = body_part_grids(body, vertices, correction_spacing)
    return GridSkinning(
        template=_blend(grids, jnp.asarray(logits, jnp.float32)),
        correction=jnp.zeros((correction_grids.num_nodes, num_logits(body.tree)), jnp.float32),
        grids=grids,
        correction_grids=correction_grids,
        tree=body.tree,
    )


def random_grid_skinning(
    body: BodyModel,
    vertices: Float[np.ndarray, "V 3"],
    spacing: GridSpacing,
    correction_spacing: GridSpacing,
    *,
    key: PRNGKeyArray,
    scale: float = 0.1,
) -> GridSkinning:
    """The same grids, with nothing of the body's weights in them.

    The template's logits are zero; the correction's are normal deviates of `scale`. Only where
    the nodes lie, finer at hands and face, is told by the body.
    """
    grids = body_part_grids(body, vertices, spacing)
    correction_grids = body_part_grids(body, vertices, correction_spacing)
    logits = num_logits(body.tree)
    correction = scale * jax.random.normal(key, (correction_grids.num_nodes, logits), jnp.float32)
    return GridSkinning(
        template=jnp.zeros((grids.num_nodes, logits), jnp.float32),
        correction=_blend(correction_grids, correction),
        grids=grids,
        correction_grids=correction_grids,
        tree=body.tree,
    )


_blend = eqx.filter_jit(PartGrids.blend)
_locate = eqx.filter_jit(PartGrids.locate)


def _smooth_away_from_surface(
    vertices: np.ndarray, grids: PartGrids, weights: np.ndarray, steps: int
) -> np.ndarray:
    """Average with neighbours of the same grid; nodes of cells that the surface crosses stay."""
    from scipy.sparse import coo_array

    cell, _, _ = _locate(grids, jnp.asarray(vertices, jnp.float32))
    fixed = np.zeros(len(weights), bool)
    fixed[np.asarray(grids.cells)[np.asarray(cell)].ravel()] = True
    free = np.flatnonzero(~fixed)

    cells = np.unique(np.asarray(grids.cells), axis=0)
    # The twelve edges of a cell: corners that differ in one bit.
    edges = np.array([(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit])
    pairs = cells[:, np.concatenate([edges, edges[:, ::-1]])].reshape(-1, 2)
    links = coo_array((np.ones(len(pairs), np.float32), pairs.T), (len(weights),) * 2).tocsr()
    links.data[:] = 1  # shared edges were counted once a cell
    links = links[free]
    degree = np.diff(links.indptr)
    links.data /= np.repeat(np.maximum(degree, 1), degree).astype(np.float32)
    smooth = weights.astype(np.float32)
    for _ in range(steps):
        smooth[free] = links @ smooth
    return smooth


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points on triangles `(N, 3, 3)`, clipped to the triangle."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d = points - corners[:, 0]
    a, b, c = (e1 * e1).sum(1), (e1 * e2).sum(1), (e2 * e2).sum(1)
    p, q = (d * e1).sum(1), (d * e2).sum(1)
    det = np.maximum(a * c - b * b, 1e-30)
    v, w = (c * p - b * q) / det, (a * q - b * p) / det
    share = np.clip(np.stack([1 - v - w, v, w], 1), 0, 1)
    return share / share.sum(1, keepdims=True)
