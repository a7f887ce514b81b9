"""Rows in blocks, two of them at a time."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np


def in_blocks(
    work: Callable[[slice], tuple[np.ndarray, ...]], count: int, rows: int
) -> tuple[np.ndarray, ...]:
    """What `work` makes of each `rows` of `count` rows, arrays put together in order.

    Two threads: NumPy and compiled fields let go of the interpreter's lock for most of the time.
    """
    if count <= rows:
        return work(slice(0, count))
    slices = [slice(start, min(start + rows, count)) for start in range(0, count, rows)]
    with ThreadPoolExecutor(2) as pool:
        parts = pool.map(work, slices)
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True))
