"""Labelled points of many frames, with the roots that were found for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..body import BodyModel, BodyParams, bone_transforms, canonical_vertices
from ..correspondence import ClosedFormNewton, StartTable, search_grid, start_table
from ..fields import (
    AbstractSkinningField,
    GridSkinning,
    PartGrids,
    TabulatedSkinning,
    body_part_grids,
    pose_grid,
    tabulate,
)
from ..frames import Frame, Frames, nearest_part_labels
from ..kinematics import skin_points, solve_3x3
from ..sampling import FrameSamples, sample_frame
from .check import FrameCheck
from .config import FitConfig, SearchConfig


class FramePool(eqx.Module):
    """Points of F frames, N each, in rows: those with several roots first, those without last.

    Translation is removed from points and transforms.

    - `points`: `(F, N, 3)`; `parts`: `(F, N)`; `distance`: `(F, N)`, positive inside.
    - `root`: `(F, N, 3)` the first root; `others`: `(F, Q, K - 1, 3)` further ones of the first Q
      rows, with `others_valid`.
    - `found`, `several`: `(F,)` rows that have a root, and more than one.
    - `transforms`: `(F, J, 4, 4)`; `params`: batched over F.
    - `share`: of the points with a root, those with several, when roots were first searched.
    """

    points: Float[Array, "F N 3"]
    parts: Int[Array, "F N"]
    distance: Float[Array, "F N"]
    root: Float[Array, "F N 3"]
    others: Float[Array, "F Q K 3"]
    others_valid: Bool[Array, "F Q K"]
    found: Int[Array, " F"]
    several: Int[Array, " F"]
    transforms: Float[Array, "F J 4 4"]
    params: BodyParams
    share: Float[Array, ""] | None = None


def centred(params: BodyParams) -> BodyParams:
    """The same parameters without translation."""
    return eqx.tree_at(lambda p: p.transl, params, jnp.zeros_like(params.transl))


def frame_labels(body: BodyModel, frame: Frame) -> Int[np.ndarray, " V"]:
    """A frame's own part labels, or those of the nearest vertices of the posed body."""
    if frame.part_labels is not None:
        return frame.part_labels
    return nearest_part_labels(body, frame.params, frame.vertices)


def label_frames(
    body: BodyModel,
    frames: Frames,
    config: FitConfig,
    *,
    bar: Any,
    notices: list[str] | None = None,
) -> FramePool:
    """Draw and label the points of every frame. Roots come later.

    One mesh is held at a time, and memory grows with the points kept: 29 bytes each, with their
    roots. Draws are keyed by seed and place in `frames`.

    **Warns:** `TrainingNotice` naming frames whose mesh and parameters do not fit; the messages
    are added to `notices`.
    """
    drawn = []
    check = FrameCheck(body)
    for k in range(len(frames)):
        frame = frames[k]
        check.look(frame)
        drawn.append(draw_points(body, frame, config, place=k))
        bar.update(1)
    check.notify(notices)
    return pool_of(body, drawn, frames.params)


def draw_points(
    body: BodyModel, frame: Frame, config: FitConfig, *, place: int, round_number: int = 0
) -> FrameSamples:
    """Labelled points of one frame, without its translation: a function of seed, place and round.

    Round 0 is the first drawing.
    """
    key = (config.seed, place, round_number) if round_number else (config.seed, place)
    rng = np.random.default_rng(key)
    samples = sample_frame(frame, frame_labels(body, frame), config.points, rng)
    shift = np.asarray(frame.params.transl, np.float32)
    return samples._replace(points=samples.points - shift, parts=samples.parts.astype(np.int8))


def pool_of(body: BodyModel, drawn: Sequence[FrameSamples], params: BodyParams) -> FramePool:
    """A pool of points of frames with these parameters, without roots."""
    params = centred(params)
    transforms = _bone_transforms(body, params)
    count, size = len(drawn), len(drawn[0].points)
    return FramePool(
        points=jnp.asarray(np.stack([samples.points for samples in drawn])),
        parts=jnp.asarray(np.stack([samples.parts for samples in drawn])),
        distance=jnp.asarray(np.stack([samples.distance for samples in drawn])),
        root=jnp.zeros((count, size, 3)),
        others=jnp.zeros((count, 1, 0, 3)),
        others_valid=jnp.zeros((count, 1, 0), bool),
        found=jnp.full(count, size, jnp.int32),
        several=jnp.zeros(count, jnp.int32),
        transforms=jnp.asarray(transforms, jnp.float32),
        params=jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params),
    )


# Here and below: made once, so that a second run, or the next polish, does not compile again.
@eqx.filter_jit
def _bone_transforms(body: BodyModel, params: BodyParams) -> Float[Array, "T J 4 4"]:
    return jax.vmap(lambda p: bone_transforms(body, p))(params)


tabulate_on = eqx.filter_jit(tabulate)


def grids_for_search(
    body: BodyModel, betas: Any, skinning: AbstractSkinningField, config: FitConfig
) -> PartGrids:
    """Grids around the person's canonical body; of a grid field, its own."""
    if isinstance(skinning, GridSkinning):
        return skinning.grids
    vertices = np.asarray(canonical_vertices(body, jnp.asarray(betas)), np.float64)
    return body_part_grids(body, vertices, config.search.grid)


def tabulate_for_search(
    body: BodyModel, betas: Any, skinning: AbstractSkinningField, config: FitConfig
) -> TabulatedSkinning:
    """The field on these grids."""
    return tabulate_on(skinning, grids_for_search(body, betas, skinning, config))


def find_roots(
    body: BodyModel,
    betas: Any,
    skinning: AbstractSkinningField,
    pool: FramePool,
    config: FitConfig,
    *,
    bar: Any,
) -> FramePool:
    """Search every point of the pool on the tabulated field, frame by frame."""
    table = tabulate_for_search(body, betas, skinning, config)
    return search_roots(body, table, pool, config, bar=bar)


def search_roots(
    body: BodyModel,
    table: TabulatedSkinning,
    pool: FramePool,
    config: FitConfig,
    *,
    bar: Any = None,
) -> FramePool:
    """The same on a field that is tabulated already."""
    starts = start_table(body.tree, config.search.starts)
    solver = ClosedFormNewton(atol=config.search.atol, divergence=1.0)

    rows = []
    for k in range(pool.points.shape[0]):
        frame = pool.points[k], pool.parts[k], pool.transforms[k]
        x_c, valid = _search_frame(table, *frame, starts, solver, config.search)
        rows.append((np.asarray(x_c), np.asarray(valid)))
        if bar is not None:
            bar.update(1)
    return _ordered(pool, np.stack([r[0] for r in rows]), np.stack([r[1] for r in rows]))


@eqx.filter_jit
def _search_frame(
    table: TabulatedSkinning,
    points: Float[Array, "N 3"],
    parts: Int[Array, " N"],
    transforms: Float[Array, "J 4 4"],
    starts: StartTable,
    solver: ClosedFormNewton,
    options: SearchConfig,
) -> tuple[Array, Array]:
    found = search_grid(
        pose_grid(table, transforms),
        points,
        parts,
        transforms,
        starts,
        solver=solver,
        keep=options.keep,
        max_steps=options.max_steps,
    )
    return found.x_c, found.valid


def _ordered(pool: FramePool, roots: np.ndarray, valid: np.ndarray) -> FramePool:
    """Rows by their number of roots; valid roots come first in a row already."""
    # What a search that failed has come to may be anything, NaN too: masked values are finite.
    roots = np.where(valid[..., None], roots, 0)
    count = valid.sum(-1)
    order = np.argsort(-count, axis=1, kind="stable")
    several = (count > 1).sum(1)
    width = max(int(several.max()), 1)

    def sort(leaf: Array | np.ndarray) -> np.ndarray:
        values = np.asarray(leaf)
        index = order.reshape(*order.shape, *(1,) * (values.ndim - 2))
        return np.take_along_axis(values, index, axis=1)

    roots, valid = sort(roots), sort(valid)
    return FramePool(
        points=jnp.asarray(sort(pool.points)),
        parts=jnp.asarray(sort(pool.parts)),
        distance=jnp.asarray(sort(pool.distance)),
        root=jnp.asarray(roots[:, :, 0]),
        others=jnp.asarray(roots[:, :width, 1:]),
        others_valid=jnp.asarray(valid[:, :width, 1:]),
        found=jnp.asarray((count > 0).sum(1), jnp.int32),
        several=jnp.asarray(several, jnp.int32),
        transforms=pool.transforms,
        params=pool.params,
        share=jnp.asarray(several.sum() / max((count > 0).sum(), 1), jnp.float32),
    )


def rows_in_turn(number: int, count: int, total: int) -> Int[np.ndarray, " r"]:
    """The frames of round 1, 2, ... if each takes the next `count` of `total`, or all of fewer."""
    count = min(count, total)
    return ((number - 1) * count + np.arange(count)) % total


def polish_roots(
    skinning: AbstractSkinningField,
    table: TabulatedSkinning,
    pool: FramePool,
    *,
    steps: int,
    rows: Int[np.ndarray, " r"] | None = None,
) -> FramePool:
    """Move stored roots, of these frames or of all, to where the field has them now.

    By Newton steps. Residuals are the field's own; Jacobians are the table's, which are close and
    cost a lookup.
    """
    stored = pool.points, pool.root, pool.others, pool.transforms
    if rows is None or len(rows) == len(pool.points):
        root, others = _polish(skinning, table, stored, steps)
    else:
        some = jax.tree.map(lambda leaf: leaf[rows], stored)
        root, others = _polish(skinning, table, some, steps)
        root, others = pool.root.at[rows].set(root), pool.others.at[rows].set(others)
    return eqx.tree_at(lambda p: (p.root, p.others), pool, (root, others))


@eqx.filter_jit
def _polish(
    field: AbstractSkinningField, table: TabulatedSkinning, stored: tuple, steps: int
) -> tuple[Array, Array]:
    def one_frame(frame: tuple) -> tuple:
        points, root, others, transforms = frame
        grid = pose_grid(table, transforms)

        def newton(x: Array, target: Array) -> Array:
            _, jacobian = grid(x)
            off = skin_points(x, field(x), transforms) - target
            step = solve_3x3(jacobian, off)
            # A root that has to go further than this was not this root.
            ok = jnp.sum(step**2) < 0.02**2
            return jnp.where(ok, x - step, x)

        targets = jnp.broadcast_to(points[: others.shape[0], None], others.shape)
        for _ in range(steps):
            root = jax.vmap(newton)(root, points)
            others = jax.vmap(jax.vmap(newton))(others, targets)
        return root, others

    return jax.lax.map(one_frame, stored)
