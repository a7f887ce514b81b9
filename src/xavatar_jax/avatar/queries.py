"""An avatar's model at many points: canonical points in batches, posed points through a search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..body import BodyModel, BodyParams, bone_transforms, with_betas
from ..correspondence import (
    ClosedFormNewton,
    Roots,
    StartSet,
    best_root,
    implicit_root,
    polish,
    search_grid,
    start_table,
)
from ..fields import (
    AvatarModel,
    GridSpacing,
    PosedGrid,
    TabulatedSkinning,
    pose_grid,
)
from ..kinematics import skin_points

# The search on the table only has to come near: roots are polished on the field itself. Near the
# edge of a fold, the table may have several places for one root, so more of them are kept.
_NEAR, _NEAR_MORE = 1e-3, 6
_DIVERGENCE = 1.0
_CHUNK = 8192
_PROJECT_STEPS, _PROJECT_STEP = 3, 0.003  # metres
LARGEST_OFFSET = _PROJECT_STEPS * _PROJECT_STEP


@dataclass(frozen=True)
class SearchSpec:
    """How a query finds the canonical points of a posed point.

    - `starts`: which bones start the search.
    - `grid`: node distances of the table of weights that is searched.
    - `keep`: largest number of roots per point.
    - `atol`: residual of a root on the skinning field, metres.
    - `max_steps`: steps of the search on the table.
    """

    starts: StartSet = "part_aware"
    grid: GridSpacing = GridSpacing()
    keep: int = 6
    atol: float = 1e-5
    max_steps: int = 15


class PosedField(eqx.Module):
    """A model with what a query in posed space needs. See `Avatar.posed_field`.

    It is a pytree: pass it to `jax.jit` as an argument.

    - `betas`: the shape of the person, which replaces that of parameters.
    - `table`: the skinning weights on the nodes of grids.
    """

    model: AvatarModel
    body: BodyModel
    betas: Float[Array, " S"]
    table: TabulatedSkinning
    search: SearchSpec = eqx.field(static=True, default=SearchSpec())


class Query(NamedTuple):
    """Answers for N posed points.

    - `level`: `(N,)` the geometry field at the best root; meaningful where `found`.
    - `x_c`: `(N, 3)` that root, metres.
    - `found`: `(N,)` whether the skinning field carries `x_c` to the point, within `atol`.
    """

    level: Float[Array, " N"]
    x_c: Float[Array, "N 3"]
    found: Bool[Array, " N"]


def query(
    field: PosedField, points: Float[Array, "N 3"], params: BodyParams, parts: Int[Array, " N"]
) -> Query:
    """The model at posed points (metres) of one frame. Works under `jax.jit`.

    `parts` decides where the search of each point starts: a part label, or a row of a start table
    made with pairs, as `Avatar.start_rows` finds for any points. It may be traced. Points are taken
    8192 at a time, so memory does not grow with their number.

    Roots of the tabulated skinning field are moved to roots of the field itself by Newton's method,
    and kept if the residual there is below `atol`; of several, the one with the largest level
    counts. Derivatives with respect to points, parameters and model pass it by the implicit
    function theorem.
    """
    # Near the origin: float32 resolves a micrometre there, but not in a room or a camera's space.
    points = jnp.asarray(points) - params.transl
    params = with_betas(params, field.betas)
    params = eqx.tree_at(lambda p: p.transl, params, jnp.zeros_like(params.transl))
    transforms = bone_transforms(field.body, params)
    condition = field.model.geometry.condition(params)
    fixed = jax.lax.stop_gradient((field.table, transforms))
    posed = _Posed(field, pose_grid(*fixed), transforms, condition)
    if len(points) <= _CHUNK:
        return _query_chunk(posed, points, parts)
    fill = -len(points) % _CHUNK
    padded = jnp.pad(points, ((0, fill), (0, 0))), jnp.pad(parts, (0, fill), constant_values=-1)
    chunks = jax.tree.map(lambda v: v.reshape(-1, _CHUNK, *v.shape[1:]), padded)
    answers = jax.lax.map(lambda chunk: _query_chunk(posed, *chunk), chunks)
    return jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:])[: len(points)], answers)


def occupancy(
    field: PosedField, points: Float[Array, "N 3"], params: BodyParams, parts: Int[Array, " N"]
) -> Float[Array, " N"]:
    """Probability that posed points are inside, 0 to 1; 0 where no root is found.

    Works under `jax.jit`; arguments are those of `query`.
    """
    answer = query(field, points, params, parts)
    return jnp.where(answer.found, field.model.link.probability(answer.level), 0.0)


class _Posed(NamedTuple):
    """A field in one frame."""

    field: PosedField
    guide: PosedGrid
    transforms: Float[Array, "J 4 4"]
    condition: PyTree[Array]


def _query_chunk(posed: _Posed, points: Float[Array, "N 3"], parts: Int[Array, " N"]) -> Query:
    model = posed.field.model
    roots = _search(posed, jax.lax.stop_gradient(points), parts)
    chosen, found = best_root(model.geometry, roots.x_c, roots.valid, posed.condition)

    def answer(x_c: Array, x_d: Array) -> tuple[Array, Array]:
        # The value is the root that was tested; only the derivative is that of one more step.
        differentiable = implicit_root(x_c, x_d, model.skinning, posed.transforms)[0]
        x_c = x_c + (differentiable - jax.lax.stop_gradient(differentiable))
        return model.geometry(x_c, posed.condition).level, x_c

    level, x_c = jax.vmap(answer)(chosen, points)
    return Query(level, x_c, found)


def _search(posed: _Posed, points: Array, parts: Array) -> Roots:
    """Roots of the skinning field itself, found on the table and polished."""
    field, search = posed.field, posed.field.search
    skinning, transforms = jax.lax.stop_gradient((field.model.skinning, posed.transforms))
    near = search_grid(
        posed.guide,
        points,
        parts,
        transforms,
        start_table(field.body.tree, search.starts, pairs=True),
        solver=ClosedFormNewton(atol=_NEAR, divergence=_DIVERGENCE),
        keep=search.keep + _NEAR_MORE,
        max_steps=search.max_steps,
        merge=0.0,
    )
    return polish(skinning, near, points, transforms, keep=search.keep, atol=search.atol)


def padded_size(count: int) -> int:
    """One of few sizes that holds `count` points: a power of two from 256, then whole chunks."""
    return count + -count % _CHUNK if count > _CHUNK else max(256, 1 << (count - 1).bit_length())


@eqx.filter_jit
def skin_weights(model: AvatarModel, points: Float[Array, "N 3"]) -> Float[Array, "N J"]:
    return jax.vmap(model.skinning)(points)


@eqx.filter_jit
def levels(model: AvatarModel, points: Array, condition: Any) -> Float[Array, " N"]:
    return jax.vmap(lambda x: model.geometry(x, condition).level)(points)


@eqx.filter_jit
def gradients(model: AvatarModel, points: Array, condition: Any) -> Float[Array, "N 3"]:
    return jax.vmap(jax.grad(lambda x: model.geometry(x, condition).level))(points)


@eqx.filter_jit
def colors(model: AvatarModel, points: Array, condition: Any) -> Float[Array, "N 3"]:
    """RGB of a model with a colour field, 0 to 1, with outward normals."""
    assert model.color is not None
    color = model.color

    def one(x: Array) -> Array:
        def value(x: Array) -> tuple[Array, Array | None]:
            found = model.geometry(x, condition)
            return found.level, found.feature

        gradient, feature = jax.grad(value, has_aux=True)(x)
        normal = -gradient / jnp.sqrt(jnp.sum(gradient**2) + 1e-12)
        return color(x, feature, normal)

    return jax.vmap(one)(points)


@eqx.filter_jit
def project(model: AvatarModel, points: Array, condition: Any) -> Float[Array, "N 3"]:
    """Move points of the neutral surface to the surface of a condition.

    By three Newton steps along the gradient of at most 3 mm each. The neutral points are moved,
    and carried at the end: the inverse of `carry` costs more than the field.
    """

    def value(x: Array) -> Array:
        return model.geometry.carried_value(x, condition).level

    def step(_: int, x: Array) -> Array:
        f, g = jax.value_and_grad(value)(x)
        slope = jnp.sqrt(jnp.sum(g**2) + 1e-12)
        return x - g / slope * jnp.clip(f / slope, -_PROJECT_STEP, _PROJECT_STEP)

    def one(x: Array) -> Array:
        return model.geometry.carry(jax.lax.fori_loop(0, _PROJECT_STEPS, step, x), condition)

    return jax.vmap(one)(points)


@eqx.filter_jit
def skin(model: AvatarModel, points: Array, transforms: Array) -> Float[Array, "N 3"]:
    return jax.vmap(lambda x: skin_points(x, model.skinning(x), transforms))(points)


def in_batches(
    function: Callable[[Array], Array], points: Float[np.ndarray, "N 3"], batch: int
) -> np.ndarray:
    """Apply a jitted function to batches of one size, the last one padded: it never retraces."""
    count = len(points)
    padded = np.concatenate([points, np.repeat(points[:1], -count % batch, axis=0)])
    # All are dispatched before the first is read: they overlap.
    parts = [
        function(jnp.asarray(padded[k : k + batch], jnp.float32))
        for k in range(0, len(padded), batch)
    ]
    return np.concatenate([np.asarray(part) for part in parts])[:count]
