"""Part grids: nodes near the body, coarse for the trunk, fine for hands and face.

One coarse grid covers everything; each fine grid is a box aligned with coarse cells, so that a
point is looked up in exactly one grid. Cells near the body store their nodes. In a fine box,
further from hands and face than its own band (hair, hats, sleeves), the coarse grid answers. Where
a fine grid ends the values are those of the coarse grid's own interpolation, reached over a margin:
the interpolated field is continuous. Beyond the coarse grid's band a cell answers with the nearest
stored one, and `covers` is false.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from .roles import misshapen

CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.int32)


@dataclass(frozen=True)
class GridSpacing:
    """Node distances and band widths in metres; margins in cells of the coarse grid.

    A fine grid passes into the coarse one over `margin` at its box's sides, over `fine_margin`
    where its band ends inside.
    """

    body: float = 0.016
    hands: float = 0.004
    face: float = 0.008
    band: float = 0.08
    fine_band: float = 0.03
    margin: float = 1.5
    fine_margin: float = 0.5


class PartGrids(eqx.Module):
    """Where the nodes are. Values live outside, one row a node.

    Grid 0 is the coarse one. All grids share one array of nodes and one of cells, of which the
    first `coarse_cells` are of grid 0; a cell lists its eight nodes.
    """

    nodes: Float[Array, "N 3"]
    cells: Int[Array, "C 8"]
    covered: Bool[Array, " C"]
    index: Int[Array, " dense"]
    origin: Float[Array, "G 3"]
    spacing: Float[Array, " G"]
    shape: Int[Array, "G 3"]
    offset: Int[Array, " G"]
    blend_nodes: Int[Array, " B"]
    blend_cells: Int[Array, "B 8"]
    blend_lerp: Float[Array, "B 8"]
    blend_share: Float[Array, " B"]
    coarse_cells: Int[Array, ""]

    @property
    def num_nodes(self) -> int:
        """N, nodes of all grids together."""
        return self.nodes.shape[0]

    def faults(self) -> Iterator[tuple[str, str]]:
        """Leaves that do not fit one another: see `check_model`."""
        cells, grids, blended = len(self.cells), len(self.origin), len(self.blend_nodes)
        yield from misshapen(self, nodes=(None, 3), cells=(None, 8), covered=(cells,))
        yield from misshapen(self, origin=(None, 3), spacing=(grids,), shape=(grids, 3))
        yield from misshapen(self, offset=(grids,), coarse_cells=(), blend_nodes=(None,))
        dense = np.asarray(self.shape, np.int64).prod(1)
        yield from misshapen(self, index=(int(dense.sum()),))
        yield from misshapen(self, blend_cells=(blended, 8), blend_lerp=(blended, 8))
        yield from misshapen(self, blend_share=(blended,))
        limits = {
            **dict.fromkeys(("cells", "blend_nodes", "blend_cells"), self.num_nodes),
            "index": cells,
            "offset": int(dense.sum()),
            "coarse_cells": cells + 1,
        }
        for name, limit in limits.items():
            values = np.asarray(getattr(self, name))
            if values.size and not (values.min() >= 0 and values.max() < limit):
                yield name, f"values {values.min()} to {values.max()}, expected 0 to {limit - 1}"

    def locate(self, x: Float[Array, "*p 3"]) -> tuple[Array, Array, Array]:
        """Cell of each point, the position in it (0 to 1 an axis inside), and its spacing."""
        grid = jnp.zeros(x.shape[:-1], jnp.int32)
        for g in range(1, self.origin.shape[0]):  # a handful of boxes, not joints
            size = self.shape[g].astype(x.dtype) * self.spacing[g].astype(x.dtype)
            local = x - self.origin[g].astype(x.dtype)
            grid = jnp.where(jnp.all((local >= 0) & (local < size), axis=-1), g, grid)
        spacing = self.spacing[grid].astype(x.dtype)
        u = (x - self.origin[grid].astype(x.dtype)) / spacing[..., None]
        shape = self.shape[grid]
        ijk = jnp.clip(jnp.floor(u).astype(jnp.int32), 0, shape - 1)
        cell_low = ijk.astype(x.dtype)
        fraction = jnp.clip(u - cell_low, 0, 1)
        flat = (ijk[..., 0] * shape[..., 1] + ijk[..., 1]) * shape[..., 2] + ijk[..., 2]
        cell = self.index[self.offset[grid] + flat]
        # Where a fine box leaves the answer to the coarse grid, the place is that in its cell.
        coarse = cell < self.coarse_cells
        # In floating point: vector code has no division of integers.
        ratio = jnp.round(self.spacing[0] / self.spacing).astype(x.dtype)[grid][..., None]
        share = 1 / ratio
        first = ratio * jnp.floor((cell_low + 0.5) * share)
        fraction = jnp.where(coarse[..., None], (cell_low - first + fraction) * share, fraction)
        return cell, fraction, jnp.where(coarse, self.spacing[0].astype(x.dtype), spacing)

    def covers(self, x: Float[Array, "*p 3"]) -> Bool[Array, "*p"]:
        """Whether points lie in cells that store their nodes."""
        cell, _, _ = self.locate(x)
        low, spacing = self.origin[0].astype(x.dtype), self.spacing[0].astype(x.dtype)
        high = low + self.shape[0].astype(x.dtype) * spacing
        return self.covered[cell] & jnp.all((x >= low) & (x <= high), axis=-1)

    def interpolate(
        self, values: Float[Array, "N K"], x: Float[Array, "*p 3"]
    ) -> Float[Array, "*p K"]:
        """Trilinear interpolation of node values."""
        cell, fraction, _ = self.locate(x)
        return (lerp_weights(fraction)[..., None] * values[self.cells[cell]]).sum(-2)

    def blend(self, values: Float[Array, "N K"]) -> Float[Array, "N K"]:
        """Make values continuous across grids: fine nodes near a border follow the coarse grid."""
        coarse = (self.blend_lerp[..., None] * values[self.blend_cells]).sum(1)
        share = self.blend_share[:, None]
        mixed = share * coarse + (1 - share) * values[self.blend_nodes]
        return values.at[self.blend_nodes].set(mixed)


def lerp_weights(fraction: Float[Array, "*p 3"]) -> Float[Array, "*p 8"]:
    """Weights of a cell's eight nodes at a position in it."""
    f = fraction[..., None, :]
    return jnp.where(CORNERS == 1, f, 1 - f).prod(-1)


@jax.custom_jvp
def lerp(
    fraction: Float[Array, "levels 3"], values: Float[Array, "levels 8 F"]
) -> Float[Array, "levels F"]:
    """Trilinear interpolation between the values of cells' nodes."""
    return jnp.einsum("lc,lcf->lf", lerp_weights(fraction), values)


# The derivative with respect to the place, written out by axis: on a CPU it takes a third of the
# time of that of the weights' product.
@partial(lerp.defjvp, symbolic_zeros=True)
def _lerp_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    (fraction, values), (moves, changes) = primals, tangents
    tangent = jnp.zeros((len(values), values.shape[-1]), values.dtype)
    if not isinstance(changes, SymbolicZero):
        tangent = tangent + lerp(fraction, changes)
    if not isinstance(moves, SymbolicZero):
        corner = values.reshape(-1, 2, 2, 2, values.shape[-1])
        x, y, z = jnp.moveaxis(fraction[..., None], 1, 0)

        def between(pair: Array, share: Array) -> Array:
            return pair[:, 0] + share * (pair[:, 1] - pair[:, 0])

        along_x = corner[:, 1] - corner[:, 0]
        at_x = between(corner, x[..., None, None])
        along_y = at_x[:, 1] - at_x[:, 0]
        at_y = between(at_x, y[..., None])
        slopes = (
            between(between(along_x, y[..., None]), z),
            between(along_y, z),
            at_y[:, 1] - at_y[:, 0],
        )
        for axis, slope in enumerate(slopes):
            tangent = tangent + moves[:, axis, None] * slope
    return lerp(fraction, values), tangent


def build_part_grids(
    vertices: Float[np.ndarray, "V 3"],
    labels: Int[np.ndarray, " V"],
    spacing: GridSpacing,
    *,
    fine_parts: dict[str, tuple[tuple[int, ...], float]],
) -> PartGrids:
    """Lay grids around canonical vertices (NumPy, at data time).

    `fine_parts` maps a name to the part labels whose vertices its box encloses and its spacing,
    which is rounded down to a whole fraction of the coarse one. A part without vertices gets no
    grid.
    """
    coarse = spacing.body
    low = np.floor((vertices.min(0) - 2 * spacing.band) / coarse) * coarse
    shape = np.ceil((vertices.max(0) + 2 * spacing.band - low) / coarse).astype(int)
    boxes = [(low, shape, coarse, spacing.band, vertices)]
    for members, wanted in fine_parts.values():
        own = vertices[np.isin(labels, members)]
        if not len(own):
            continue
        ratio = int(np.ceil(coarse / wanted - 1e-9))
        reach = spacing.fine_band
        first = np.floor((own.min(0) - reach - low) / coarse)
        last = np.ceil((own.max(0) + reach - low) / coarse)
        near = vertices[
            np.all(
                (vertices > low + first * coarse - reach)
                & (vertices < low + last * coarse + reach),
                axis=1,
            )
        ]
        boxes.append(
            (
                low + first * coarse,
                ((last - first) * ratio).astype(int),
                coarse / ratio,
                reach,
                near,
            )
        )
    return _assemble(boxes, spacing)


def _assemble(boxes: list, spacing: GridSpacing) -> PartGrids:
    from scipy.ndimage import distance_transform_edt

    nodes, cells, covered, index, offsets, depths = [], [], [], [], [], []
    node_count = cell_count = dense_count = coarse_cells = 0
    coarse_low, _, coarse_step, _, _ = boxes[0]
    coarse_index = np.zeros(0, int)
    for g, (origin, shape, step, band, points) in enumerate(boxes):
        near = _cells_near(origin, shape, step, band, points)
        flat = np.flatnonzero(near.ravel())
        ijk = np.stack(np.unravel_index(flat, near.shape), 1)
        corner = ijk[:, None, :] + CORNERS
        stride = np.array([(shape[1] + 1) * (shape[2] + 1), shape[2] + 1, 1])
        unique, inverse = np.unique(corner @ stride, return_inverse=True)
        position = np.stack(np.unravel_index(unique, tuple(shape + 1)), 1)
        nodes.append(origin + position * step)
        cells.append(inverse.reshape(-1, 8) + node_count)
        covered.append(np.ones(len(flat), bool))
        order = np.full(near.shape, -1)
        order.ravel()[flat] = np.arange(len(flat)) + cell_count
        if g == 0:
            # A cell without nodes answers with the nearest cell that has some. Those stand-ins are
            # doubled, so that a cell knows whether it was asked for itself.
            nearest: Any = distance_transform_edt(
                ~near, return_distances=False, return_indices=True
            )
            dense = coarse_index = np.where(near, order, order[tuple(nearest)] + len(flat))
            cells.append(cells[-1])
            covered.append(~covered[-1])
            coarse_cells = 2 * len(flat)
        else:
            first = np.rint((origin - coarse_low) / coarse_step).astype(int)
            ratio = int(np.rint(coarse_step / step))
            depths.append(step * _nodes_to_edge(near)[tuple(position.T)])
            under = [first[k] + np.arange(shape[k]) // ratio for k in range(3)]
            dense = np.where(near, order, coarse_index[np.ix_(*under)])
        index.append(dense.ravel())
        offsets.append(dense_count)
        node_count += len(unique)
        cell_count += (2 if g == 0 else 1) * len(flat)
        dense_count += near.size
    all_nodes, all_cells = np.concatenate(nodes), np.concatenate(cells)
    all_index = np.concatenate(index)
    margins = _margins(nodes, depths, boxes, all_cells, all_index, spacing)
    return PartGrids(
        nodes=jnp.asarray(all_nodes, jnp.float32),
        cells=jnp.asarray(all_cells, jnp.int32),
        covered=jnp.asarray(np.concatenate(covered)),
        index=jnp.asarray(all_index, jnp.int32),
        origin=jnp.asarray(np.stack([b[0] for b in boxes]), jnp.float32),
        spacing=jnp.asarray([b[2] for b in boxes], jnp.float32),
        shape=jnp.asarray(np.stack([b[1] for b in boxes]), jnp.int32),
        offset=jnp.asarray(offsets, jnp.int32),
        blend_nodes=jnp.asarray(margins.nodes, jnp.int32),
        blend_cells=jnp.asarray(margins.cells, jnp.int32),
        blend_lerp=margins.lerp,
        blend_share=jnp.asarray(margins.share, jnp.float32),
        coarse_cells=jnp.asarray(coarse_cells, jnp.int32),
    )


def _cells_near(
    origin: np.ndarray, shape: np.ndarray, step: float, band: float, points: np.ndarray
) -> np.ndarray:
    """Cells whose centre lies within `band` of a point."""
    from scipy.ndimage import distance_transform_edt

    occupied = np.zeros(tuple(shape), bool)
    ijk = np.floor((points - origin) / step).astype(int)
    inside = np.all((ijk >= 0) & (ijk < shape), axis=1)
    occupied[tuple(ijk[inside].T)] = True
    if not occupied.any():
        raise ValueError("a part grid has no vertices inside its box")
    away: Any = distance_transform_edt(~occupied)
    return away * step <= band + step


def _nodes_to_edge(near: Bool[np.ndarray, "x y z"]) -> Float[np.ndarray, "X Y Z"]:
    """Of every node, how many nodes away the nearest one is that has a cell without nodes.

    What is outside the box does not count.
    """
    from scipy.ndimage import distance_transform_edt

    padded = np.pad(near, 1, constant_values=True)
    x, y, z = (n + 1 for n in near.shape)
    whole = np.ones((x, y, z), bool)
    for i, j, k in CORNERS:
        whole &= padded[i : i + x, j : j + y, k : k + z]
    if whole.all():
        return np.full(whole.shape, np.inf)
    return np.asarray(distance_transform_edt(whole))


class _Margins(NamedTuple):
    """Fine nodes near where their grid ends, their coarse cell and place in it, and its share."""

    nodes: Int[np.ndarray, " B"]
    cells: Int[np.ndarray, "B 8"]
    lerp: Float[Array, "B 8"]
    share: Float[np.ndarray, " B"]


def _margins(
    nodes: list[Float[np.ndarray, "_ 3"]],
    depths: list[Float[np.ndarray, " _"]],
    boxes: list,
    cells: Int[np.ndarray, "C 8"],
    index: Int[np.ndarray, " dense"],
    spacing: GridSpacing,
) -> _Margins:
    first = np.cumsum([0, *(len(n) for n in nodes)])
    picked, places, shares = [np.zeros(0, int)], [np.zeros((0, 3))], [np.zeros(0)]
    for g in range(1, len(boxes)):
        origin, shape, step, _, _ = boxes[g]
        local = nodes[g] - origin
        depth = np.minimum(local, shape * step - local).min(1)
        t = np.minimum(
            np.clip(depth / (spacing.margin * spacing.body), 0, 1),
            np.clip(depths[g - 1] / (spacing.fine_margin * spacing.body), 0, 1),
        )
        share = 1 - t * t * (3 - 2 * t)
        rows = np.flatnonzero(share > 0)
        picked.append(rows + first[g])
        places.append(nodes[g][rows])
        shares.append(share[rows])
    # Looked up in the coarse grid alone.
    origin, shape, step, _, _ = boxes[0]
    u = (np.concatenate(places) - origin) / step
    cell = np.clip(np.floor(u + 1e-6).astype(int), 0, shape - 1)
    flat = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
    lerp = _lerp_weights(jnp.asarray(np.clip(u - cell, 0, 1), jnp.float32))
    return _Margins(np.concatenate(picked), cells[index[flat]], lerp, np.concatenate(shares))


_lerp_weights = jax.jit(lerp_weights)
