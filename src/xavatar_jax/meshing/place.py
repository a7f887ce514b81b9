"""Positions of surface vertices: between two leaves, then evenly spread, on the level set."""

import numpy as np
from jaxtyping import Float, Int

from .octree import Octree
from .sampler import FieldSampler

_MARGIN = 0.02


def place_between(
    tree: Octree, sampler: FieldSampler, leaves: Int[np.ndarray, "V 2"], steps: int
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V"]]:
    """Zeros of the field on the segments from inside leaf centres to outside ones.

    The first guess is linear; each of `steps` evaluations narrows the bracket by the Illinois
    rule, so a vertex never leaves its segment. Returns positions (V, 3) and the values there
    after the last evaluation (V,).
    """
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
        # An end that stays twice counts half: plain secants stick to one end.
        f_high = np.where(inside & (last == side), 0.5 * f_high, f_high)
        f_low = np.where(~inside & (last == side), 0.5 * f_low, f_low)
        low, f_low = np.where(inside, t, low), np.where(inside, value, f_low)
        high, f_high = np.where(inside, high, t), np.where(inside, f_high, value)
        last = side
        if step + 1 < steps:
            t = _secant(low, high, f_low, f_high)
    return start + t[:, None] * (end - start), value


def _secant(low: np.ndarray, high: np.ndarray, f_low: np.ndarray, f_high: np.ndarray) -> np.ndarray:
    """Where a line through both ends of each bracket is zero, a little inside the bracket."""
    fraction = np.clip(f_low / (f_low - f_high), _MARGIN, 1.0 - _MARGIN)
    return low + fraction * (high - low)


def spread_and_project(
    sampler: FieldSampler,
    positions: Float[np.ndarray, "V 3"],
    values: Float[np.ndarray, "V"],
    sizes: Float[np.ndarray, "V"],
    faces: Int[np.ndarray, "F 3"],
    steps: int,
) -> Float[np.ndarray, "V 3"]:
    """Move vertices towards the middle of their neighbours along the surface, then on to it.

    A vertex ends within `sizes` (its cell, metres) of where it started. A step is taken only if
    it ends closer to the level set, measured in metres by value over gradient, than a hundredth
    of the cell or than before.
    """
    origin = positions
    for _ in range(steps):
        gradient = sampler.gradient(positions, 0.05 * sizes)
        squared = np.maximum((gradient**2).sum(axis=1), np.finfo(np.float32).tiny)
        normal = gradient / np.sqrt(squared)[:, None]
        towards = 0.6 * (_neighbour_mean(positions, faces) - positions)
        towards -= (towards * normal).sum(axis=1, keepdims=True) * normal
        # First along the surface, then off the value that the old position had.
        moved = positions + towards - (values / squared)[:, None] * gradient
        moved = _within_reach(moved, positions, 0.5 * sizes)
        # The gradient turns little over half a cell: a second one would not pay.
        polished = moved - (sampler(moved) / squared)[:, None] * gradient
        polished = _within_reach(polished, moved, 0.25 * sizes)
        polished = _within_reach(polished, origin, 0.75 * sizes)
        polished_value = sampler(polished)
        tolerance = np.maximum(np.abs(values), 0.01 * sizes * np.sqrt(squared))
        accept = (np.abs(polished_value) <= tolerance) & sampler.within(polished)
        positions = np.where(accept[:, None], polished, positions)
        values = np.where(accept, polished_value, values)
    return positions


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
    positions: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Mean of each vertex's neighbours; itself if it has none."""
    start = faces.reshape(-1)
    count = np.bincount(start, minlength=len(positions))
    # Every neighbour appears twice on a closed mesh: once in each of the two faces of the edge.
    ends = positions[faces[:, [1, 2, 0]].reshape(-1)] + positions[faces[:, [2, 0, 1]].reshape(-1)]
    sums = np.stack(
        [np.bincount(start, ends[:, axis], minlength=len(positions)) for axis in range(3)], axis=1
    )
    mean = sums / np.maximum(2 * count, 1)[:, None]
    return np.where(count[:, None] > 0, mean, positions)
