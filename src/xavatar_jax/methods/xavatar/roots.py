"""Labelled points of many frames, and the cache of their roots."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...body import BodyModel, BodyParams, bone_transforms
from ...correspondence import ClosedFormNewton, StartTable, move_roots, search_grid
from ...fields import (
    AbstractGeometryField,
    AvatarModel,
    TabulatedSkinning,
    pose_grid,
    tabulate,
)
from ...sampling import VolumePoints

POLISH_LIMIT, POLISH_TOLERANCE = 0.02, 5e-4
"""Metres: a root that has to move further in one step, or that a step leaves with a larger
residual, has vanished."""
_BLOCK = 2048  # points that are polished together


class RootCache(eqx.Module):
    """Canonical points of F frames of N samples, keyed by frame and row.

    Rows are sorted by their number of roots: those with several come first, those without last.

    - `first`: `(F, N, 3)` one root a row; `valid`: `(F, N)` whether it still is one.
    - `others`: `(F, Q, K, 3)` further roots of the first Q rows, with `others_valid`.
    - `neutral`, `others_neutral`: the points of the neutral person that the frame's condition
      carries to these roots (`AbstractGeometryField.carried_from`).
    - `found`, `several`: `(F,)` rows that had a root, and more than one, when searched.
    - `share`: of the rows with a root, those with several.
    """

    first: Float[Array, "F N 3"]
    neutral: Float[Array, "F N 3"]
    valid: Bool[Array, "F N"]
    others: Float[Array, "F Q K 3"]
    others_neutral: Float[Array, "F Q K 3"]
    others_valid: Bool[Array, "F Q K"]
    found: Int[Array, " F"]
    several: Int[Array, " F"]
    share: Float[Array, ""]


class FrameData(eqx.Module):
    """What training draws from: samples of F frames, without the frames' translation.

    - `samples`: batched `(F, N)`; `transforms`: `(F, J, 4, 4)`; `params`: batched over F.
    - `roots`: of the samples' rows, where they are cached.
    - `guide`: the skinning field as a table, on which a search in the step begins, and
      `guide_source`: the learned leaves that it was made of.
    """

    samples: VolumePoints
    transforms: Float[Array, "F J 4 4"]
    params: BodyParams
    roots: RootCache | None = None
    guide: TabulatedSkinning | None = None
    guide_source: Any = None

    @property
    def num_frames(self) -> int:
        """F."""
        return self.transforms.shape[0]


def frame_data(body: BodyModel, samples: VolumePoints, params: BodyParams) -> FrameData:
    """Data of frames with these parameters, without roots."""
    params = centred(params)
    return FrameData(
        samples=jax.tree.map(jnp.asarray, samples),
        transforms=jnp.asarray(_bone_transforms(body, params), jnp.float32),
        params=jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params),
    )


def centred(params: BodyParams) -> BodyParams:
    """The same parameters without translation."""
    return eqx.tree_at(lambda p: p.transl, params, jnp.zeros_like(params.transl))


# Here and below: module-level functions, so that a second run does not compile again.
@eqx.filter_jit
def _bone_transforms(body: BodyModel, params: BodyParams) -> Float[Array, "T J 4 4"]:
    return jax.vmap(lambda p: bone_transforms(body, p))(params)


tabulated = eqx.filter_jit(tabulate)


def search_roots(
    geometry: AbstractGeometryField,
    table: TabulatedSkinning,
    data: FrameData,
    starts: StartTable,
    *,
    keep: int,
    atol: float,
    max_steps: int,
    bar: Any = None,
) -> FrameData:
    """The data with the roots of every sample on the tabulated field, searched frame by frame."""
    solver = ClosedFormNewton(atol=atol, divergence=1.0)
    x_c, valid = [], []
    for k in range(data.num_frames):
        own = data.samples.x_d[k], data.samples.part[k], data.transforms[k]
        roots, ok = _search_frame(table, own, starts, solver, keep, max_steps)
        x_c.append(np.asarray(roots))
        valid.append(np.asarray(ok))
        if bar is not None:
            bar.update(1)
    data = _sorted_by_roots(data, np.stack(x_c), np.stack(valid))
    return _with_neutral(geometry, data)


@eqx.filter_jit
def _search_frame(
    table: TabulatedSkinning,
    frame: tuple[Array, Array, Array],
    starts: StartTable,
    solver: ClosedFormNewton,
    keep: int,
    max_steps: int,
) -> tuple[Array, Array]:
    x_d, part, transforms = frame
    found = search_grid(
        pose_grid(table, transforms), x_d, part.astype(jnp.int32), transforms, starts,
        solver=solver, keep=keep, max_steps=max_steps,
    )  # fmt: skip
    return found.x_c, found.valid


@eqx.filter_jit
def _with_neutral(geometry: AbstractGeometryField, data: FrameData) -> FrameData:
    cache = data.roots
    assert cache is not None
    found = jax.lax.map(
        lambda frame: _neutral(geometry, *frame), (data.params, cache.first, cache.others)
    )
    return eqx.tree_at(lambda d: (d.roots.neutral, d.roots.others_neutral), data, found)


def _neutral(
    geometry: AbstractGeometryField,
    params: BodyParams,
    first: Float[Array, "N 3"],
    others: Float[Array, "Q K 3"],
) -> tuple[Float[Array, "N 3"], Float[Array, "Q K 3"]]:
    """The neutral points of one frame's roots."""
    condition = geometry.condition(params)
    flat = jnp.concatenate([first, others.reshape(-1, 3)])
    flat = jax.vmap(lambda x: geometry.carried_from(x, condition)[0])(flat)
    return flat[: len(first)], flat[len(first) :].reshape(others.shape)


def _sorted_by_roots(
    data: FrameData, roots: Float[np.ndarray, "F N K 3"], valid: Bool[np.ndarray, "F N K"]
) -> FrameData:
    """Rows sorted by their number of roots. Valid roots come first in a row already."""
    roots = np.where(valid[..., None], roots, 0)  # a failed search may have ended at NaN
    count = valid.sum(-1)
    order = np.argsort(-count, axis=1, kind="stable")
    several = (count > 1).sum(1)
    width = max(int(several.max()), 1)

    def sort(leaf: Any) -> np.ndarray:
        values = np.asarray(leaf)
        index = order.reshape(*order.shape, *(1,) * (values.ndim - 2))
        return np.take_along_axis(values, index, axis=1)

    roots, valid = sort(roots), sort(valid)
    first, others = jnp.asarray(roots[:, :, 0]), jnp.asarray(roots[:, :width, 1:])
    cache = RootCache(
        first=first,
        neutral=first,
        valid=jnp.asarray(valid[:, :, 0]),
        others=others,
        others_neutral=others,
        others_valid=jnp.asarray(valid[:, :width, 1:]),
        found=jnp.asarray((count > 0).sum(1), jnp.int32),
        several=jnp.asarray(several, jnp.int32),
        share=jnp.asarray(several.sum() / max((count > 0).sum(), 1), jnp.float32),
    )
    samples = jax.tree.map(lambda leaf: jnp.asarray(sort(leaf)), data.samples)
    return eqx.tree_at(
        lambda d: (d.samples, d.roots), data, (samples, cache), is_leaf=lambda x: x is None
    )


def rows_in_turn(number: int, count: int, total: int) -> Int[np.ndarray, " r"]:
    """The frames of round 1, 2, ... if each round takes the next `count` of `total`."""
    count = min(count, total)
    return ((number - 1) * count + np.arange(count)) % total


def polish_roots(
    model: AvatarModel,
    table: TabulatedSkinning,
    data: FrameData,
    *,
    steps: int,
    rows: Int[np.ndarray, " r"] | None = None,
) -> FrameData:
    """Move the roots of some frames, or of all, to where the field has them now.

    By Newton steps with the table's Jacobian. The residual is the field's own: a root that has
    vanished is not valid any more, and the first of a row comes back if it is found again.
    """
    cache = data.roots
    assert cache is not None

    def parts(c: RootCache) -> tuple[Array, ...]:
        return c.first, c.neutral, c.valid, c.others, c.others_neutral, c.others_valid

    of_frame = data.samples.x_d, data.transforms, data.params, cache.found, cache.several
    stored = *of_frame, cache.first, cache.others, cache.others_valid
    if rows is None or len(rows) == data.num_frames:
        moved = _polish(model, table, stored, steps)
    else:
        index = jnp.asarray(rows)
        some = _polish(model, table, jax.tree.map(lambda v: v[index], stored), steps)
        old = parts(cache)
        moved = jax.tree.map(lambda whole, part: whole.at[index].set(part), old, some)
    return eqx.tree_at(lambda d: parts(d.roots), data, moved)


@eqx.filter_jit
def _polish(
    model: AvatarModel, table: TabulatedSkinning, stored: tuple, steps: int
) -> tuple[Array, ...]:
    def one_frame(frame: tuple) -> tuple:
        x_d, transforms, params, found, several, first, others, others_valid = frame
        grid = pose_grid(table, transforms)

        def move(x_c: Array, x_d: Array) -> tuple[Array, Array]:
            return move_roots(
                model.skinning, grid, x_c, x_d, transforms, steps=steps, atol=POLISH_TOLERANCE,
                max_step=POLISH_LIMIT,
            )  # fmt: skip

        first, ok = _by_blocks(move, first, x_d, found)
        width, each = others.shape[:2]
        targets = jnp.repeat(x_d[:width], each, axis=0)
        moved, others_ok = _by_blocks(move, others.reshape(-1, 3), targets, several * each)
        others = moved.reshape(others.shape)
        others_ok = others_ok.reshape(others_valid.shape) & others_valid
        neutral, others_neutral = _neutral(model.geometry, params, first, others)
        return first, neutral, ok, others, others_neutral, others_ok

    return jax.lax.map(one_frame, stored)


def _by_blocks(
    move: Callable[[Array, Array], tuple[Array, Array]],
    x_c: Float[Array, "n 3"],
    x_d: Float[Array, "n 3"],
    count: Int[Array, ""],
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"]]:
    """Move the first `count` points, which is all that have a root, and call the rest no roots.

    In blocks, so that what is left out costs nothing.
    """
    total = len(x_c)
    number = -(-total // _BLOCK)
    size = -(-total // max(number, 1))

    def blocks(leaf: Array) -> Array:
        return jnp.pad(leaf, ((0, number * size - total), (0, 0))).reshape(number, size, 3)

    targets = blocks(x_d)

    def body(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        moved, ok = move(state[0][k], targets[k])
        return state[0].at[k].set(moved), state[1].at[k].set(ok)

    start = blocks(x_c), jnp.zeros((number, size), bool)
    moved, ok = jax.lax.fori_loop(0, (count + size - 1) // max(size, 1), body, start)
    return moved.reshape(-1, 3)[:total], ok.reshape(-1)[:total] & (jnp.arange(total) < count)


def replace_frames(data: FrameData, new: FrameData, rows: Int[np.ndarray, " r"]) -> FrameData:
    """The data with the samples and roots of some frames replaced.

    The room for rows with several roots is fixed: in a frame with more, the last ones keep only
    their first root.
    """
    return _replace(data, _padded_like(data, new), jnp.asarray(rows))


def _padded_like(data: FrameData, new: FrameData) -> FrameData:
    if data.roots is None or new.roots is None:
        return new
    width = data.roots.others.shape[1]
    short = max(width - new.roots.others.shape[1], 0)
    room = ((0, 0), (0, short), (0, 0))
    leaves = lambda d: (d.roots.others, d.roots.others_neutral, d.roots.others_valid)  # noqa: E731
    padded = [
        jnp.pad(leaf, (*room, *((0, 0),) * (leaf.ndim - 3)))[:, :width] for leaf in leaves(new)
    ]
    return eqx.tree_at(leaves, new, padded)


@eqx.filter_jit
def _replace(data: FrameData, new: FrameData, rows: Int[Array, " r"]) -> FrameData:
    def changed(d: FrameData) -> tuple:
        c = d.roots
        cached = () if c is None else (
            c.first, c.neutral, c.valid, c.others, c.others_neutral, c.others_valid,
            c.found, c.several,
        )  # fmt: skip
        return (*d.samples, *cached)

    put = jax.tree.map(lambda a, b: a.at[rows].set(b), changed(data), changed(new))
    return eqx.tree_at(changed, data, put)
