"""Positions of surface vertices: between two leaves, then evened out on the level set."""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..geometry import corner_matrix, vertex_normals
from .octree import Octree
from .sampler import FieldSampler, in_blocks

_MARGIN = 0.02


def place_between(
    tree: Octree, sampler: FieldSampler, leaves: Int[np.ndarray, "V 2"], steps: int
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V"], Float[np.ndarray, "V 3"]]:
    """Zeros of the field on the segments from inside leaf centres to outside ones.

    The first guess is linear; each of `steps` evaluations narrows the bracket by the Illinois
    rule, so vertices stay on their segments. Returns positions (V, 3), the values there after
    the last evaluation (V,; infinite without one), and the slopes along the segments, as vectors
    of decrease in value per metre (V, 3).
    """
    positions, values, falls = in_blocks(
        lambda rows: _placed(tree, sampler, leaves[rows], steps), len(leaves), sampler.block_rows
    )
    return positions, values, falls


def _placed(
    tree: Octree, sampler: FieldSampler, leaves: Int[np.ndarray, "V 2"], steps: int
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V"], Float[np.ndarray, "V 3"]]:
    start, end = tree.centres(leaves[:, 0]), tree.centres(leaves[:, 1])
    low, high = np.zeros(len(leaves)), np.ones(len(leaves))
    f_low, f_high = tree.value[leaves[:, 0]].copy(), tree.value[leaves[:, 1]].copy()
    last = np.zeros(len(leaves), dtype=np.int8)
    value = np.full(len(leaves), np.inf)
    t = _secant(low, high, f_low, f_high)
    for step in range(steps):
        value = sampler(start + t[:, None] * (end - start))
        inside = value > 0
        side = np.where(inside, 1, -1).astype(np.int8)
        # Halve the value at an end that is kept twice: plain secants stick to one end.
        f_high = np.where(inside & (last == side), 0.5 * f_high, f_high)
        f_low = np.where(~inside & (last == side), 0.5 * f_low, f_low)
        low, f_low = np.where(inside, t, low), np.where(inside, value, f_low)
        high, f_high = np.where(inside, high, t), np.where(inside, f_high, value)
        last = side
        if step + 1 < steps:
            t = _secant(low, high, f_low, f_high)
    along = end - start
    fall = (tree.value[leaves[:, 0]] - tree.value[leaves[:, 1]]) / (along**2).sum(axis=1)
    return start + t[:, None] * along, value, fall[:, None] * along


def _secant(low: np.ndarray, high: np.ndarray, f_low: np.ndarray, f_high: np.ndarray) -> np.ndarray:
    """Zero of the line through both ends of each bracket, kept a little inside it."""
    fraction = np.clip(f_low / (f_low - f_high), _MARGIN, 1.0 - _MARGIN)
    return low + fraction * (high - low)


def spread_and_project(
    sampler: FieldSampler,
    positions: Float[np.ndarray, "V 3"],
    values: Float[np.ndarray, "V"],
    falls: Float[np.ndarray, "V 3"],
    sizes: Float[np.ndarray, "V"],
    faces: Int[np.ndarray, "F 3"],
    steps: int,
) -> Float[np.ndarray, "V 3"]:
    """Move vertices along the surface towards the mean of their neighbours, then back on to it.

    Normals come from the mesh and slopes from `falls` (see `place_between`): vertices return along
    their normals by secant steps, without gradients of the field. They end within `sizes` (their
    cell, metres) of where they started. A step is accepted only if it ends closer to the level set
    than before or than a hundredth of the cell.
    """
    origin = positions
    for _ in range(steps):
        normal = vertex_normals(positions, faces)
        terms = _slope_terms(falls, normal)
        mean = _neighbour_mean(np.concatenate([positions, terms], axis=1), faces)
        above, below = (terms + mean[:, 3:]).T
        slopes = np.maximum(above, np.finfo(np.float32).tiny) / np.maximum(below, 1e-6)
        vertices = _Vertices(origin, positions, values, mean[:, :3], normal, slopes, sizes)
        project = partial(_projected, sampler, vertices)
        positions, values = in_blocks(project, len(positions), sampler.block_rows)
    return positions


class _Vertices(NamedTuple):
    """What a round of `spread_and_project` uses at each vertex: its arguments, the `mean` of the
    neighbours, and `slopes`, the decrease of values along the normal."""

    origin: Float[np.ndarray, "V 3"]
    positions: Float[np.ndarray, "V 3"]
    values: Float[np.ndarray, "V"]
    mean: Float[np.ndarray, "V 3"]
    normal: Float[np.ndarray, "V 3"]
    slopes: Float[np.ndarray, "V"]
    sizes: Float[np.ndarray, "V"]


def _projected(
    sampler: FieldSampler, vertices: _Vertices, rows: slice
) -> tuple[Float[np.ndarray, "R 3"], Float[np.ndarray, "R"]]:
    """One round of `spread_and_project` for some vertices: positions and the values there."""
    origin, positions, values, mean, normal, slopes, sizes = (part[rows] for part in vertices)
    towards = 0.6 * (mean - positions)
    towards -= (towards * normal).sum(axis=1, keepdims=True) * normal
    # Values fall outwards along the normal; the value at the old position is corrected as well.
    known = np.where(np.isfinite(values), values, 0.0)
    moved = positions + towards + (known / slopes)[:, None] * normal
    moved = _within_reach(moved, positions, 0.5 * sizes)
    before = sampler(moved)
    first = np.clip(before / slopes, -0.25 * sizes, 0.25 * sizes)
    polished = _within_reach(moved + first[:, None] * normal, origin, 0.75 * sizes)
    after = sampler(polished)
    # A third step uses the measured slope. It is checked unless it is tiny.
    slopes = np.clip(_ratio(before - after, first, slopes), 0.25 * slopes, 4 * slopes)
    second = np.clip(after / slopes, -0.25 * sizes, 0.25 * sizes)
    again = _within_reach(polished + second[:, None] * normal, origin, 0.75 * sizes)
    take = np.abs(second) < 2e-3 * sizes
    far = np.flatnonzero(~take)
    value = sampler(again[far])
    take[far] = np.abs(value) < np.abs(after[far])
    after[far] = np.where(take[far], value, after[far])
    polished = np.where(take[:, None], again, polished)
    tolerance = np.maximum(np.abs(values), 0.01 * sizes * slopes)
    accept = (np.abs(after) <= tolerance) & sampler.within(polished)
    return np.where(accept[:, None], polished, positions), np.where(accept, after, values)


def _slope_terms(
    falls: Float[np.ndarray, "V 3"], normal: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 2"]:
    """Numerator and denominator of a least-squares slope along the normals.

    Segments nearly parallel to the surface carry little information and get little weight.
    """
    squared = np.maximum((falls**2).sum(axis=1), np.finfo(np.float32).tiny)
    along = np.abs((falls * normal).sum(axis=1))
    return np.stack([along, along**2 / squared], axis=1)


def _ratio(a: np.ndarray, b: np.ndarray, other: np.ndarray) -> np.ndarray:
    """`a / b`, or `other` where `b` is nearly zero."""
    tiny = np.abs(b) < 1e-9
    return np.where(tiny, other, a / np.where(tiny, 1.0, b))


def _within_reach(
    positions: Float[np.ndarray, "V 3"],
    centre: Float[np.ndarray, "V 3"],
    reach: Float[np.ndarray, "V"],
) -> Float[np.ndarray, "V 3"]:
    """Pull positions back to at most `reach` from `centre`."""
    offset = positions - centre
    length = np.linalg.norm(offset, axis=1)
    scale = np.divide(reach, length, out=np.ones_like(length), where=length > reach)
    return centre + offset * scale[:, None]


def _neighbour_mean(
    values: Float[np.ndarray, "V K"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V K"]:
    """Mean over the neighbours of each vertex; its own value if it has none."""
    count = np.bincount(faces.reshape(-1), minlength=len(values))
    # On a closed mesh every neighbour appears twice: once in each face of the edge.
    corners = corner_matrix(faces, len(values), values.dtype)
    sums = corners @ (corners.T @ values) - count[:, None] * values
    mean = sums / np.maximum(2 * count, 1)[:, None]
    return np.where(count[:, None] > 0, mean, values)
