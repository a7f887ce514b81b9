"""Choosing frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from .frames import Frames


def spread(frames: Frames, n: int | None) -> Int[np.ndarray, " n"]:
    """Indices of `n` frames spread evenly over the sequences, and in time within each.

    Every sequence gets the same number of frames, as far as it has them; what a short one
    cannot give goes to the others. Deterministic and sorted.

    Args:
        frames: frames of one or more sequences.
        n: how many; None, or more than there are, gives all.

    Raises:
        ValueError: `n` is less than 1.
    """
    if n is not None and n < 1:
        raise ValueError(f"Cannot choose {n} frames; at least 1 is needed.")
    if n is None or n >= len(frames):
        return np.arange(len(frames))
    index = frames.sequence_index
    groups = [np.flatnonzero(index == i) for i in dict.fromkeys(index.tolist())]
    chosen = [
        group[_evenly(len(group), quota)]
        for group, quota in zip(groups, _quotas([len(g) for g in groups], n), strict=True)
    ]
    return np.sort(np.concatenate(chosen))


def _quotas(sizes: list[int], n: int) -> list[int]:
    """Share `n` among groups as equally as their sizes allow."""
    quotas = [0] * len(sizes)
    left = n
    while left:
        open_groups = [i for i, size in enumerate(sizes) if quotas[i] < size]
        # Fewer left than groups: give them to groups spread over the list, not to the first.
        if left < len(open_groups):
            open_groups = [open_groups[i] for i in _evenly(len(open_groups), left)]
        share = max(left // len(open_groups), 1)
        for i in open_groups:
            given = min(share, sizes[i] - quotas[i])
            quotas[i] += given
            left -= given
    return quotas


def _evenly(size: int, n: int) -> np.ndarray:
    """`n` distinct positions out of `size`, at the middles of `n` equal stretches."""
    return ((np.arange(n) + 0.5) * size / n).astype(np.int64)
