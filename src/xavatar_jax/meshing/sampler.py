"""Evaluate a field in batches of one fixed size, so that a jitted field never retraces."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import numpy as np
from jaxtyping import Float

ScalarField = Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, "N"]]
VectorField = Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, "N 3"]]


class EmptyLevelSetError(ValueError):
    """The field has no surface at the given level within the given bounds."""


class FieldSampler:
    """Calls a field on float32 batches of exactly `batch_points` rows, padding the last.

    Values are relative to `level`. Points beyond `bounds` count as outside without a call, so
    that every surface is closed at the bounds. The sampler records the range and the number of
    values. Several threads may call it if the field allows that.
    """

    def __init__(
        self,
        field: ScalarField,
        bounds: Float[np.ndarray, "2 3"],
        *,
        level: float,
        batch_points: int,
        gradient: VectorField | None = None,
        verbose: bool = False,
    ) -> None:
        if batch_points < 1:
            raise ValueError(f"batch_points must be 1 or more, found {batch_points}.")
        self.bounds = bounds
        self.lowest, self.highest, self.count = np.inf, -np.inf, 0
        self._field, self._gradient = field, gradient
        self._level, self._batch = level, batch_points
        self._lock = Lock()
        self._bar = None
        if verbose:
            from tqdm.auto import tqdm

            self._bar = tqdm(desc="meshing", unit="points", unit_scale=True, disable=None)

    def close(self) -> None:
        """End the progress bar."""
        if self._bar is not None:
            self._bar.close()

    @property
    def block_rows(self) -> int:
        """Block size for `in_blocks` that wastes few rows on padding."""
        return 4 * self._batch

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
        """Field minus level, float64, never exactly zero; negative outside the bounds."""
        within = self.within(points)
        every = bool(within.all())
        raw = self._run(self._field, points if every else points[within], ())
        values = raw.astype(np.float64) - self._level
        if len(values):
            with self._lock:
                self.lowest = min(self.lowest, float(values.min()))
                self.highest = max(self.highest, float(values.max()))
        # An exact zero has no side: count it as outside, by the smallest number that still divides.
        values[values == 0] = -np.finfo(np.float32).tiny
        if every:
            return values
        result = np.full(len(points), -1.0)
        result[within] = values
        return result

    def within(self, points: Float[np.ndarray, "N 3"]) -> np.ndarray:
        """Whether each point lies in the bounds, (N,) bool."""
        x, y, z = ((points >= self.bounds[0]) & (points <= self.bounds[1])).T
        return x & y & z

    def gradient(
        self, points: Float[np.ndarray, "N 3"], step: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 3"]:
        """Gradient from the given callable, or by differences over `step` (N,), metres."""
        if self._gradient is not None:
            return self._run(self._gradient, points, (3,)).astype(np.float64)
        # Corners of a tetrahedron: a second-order gradient from four evaluations.
        corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float64)
        probes = points[:, None] + step[:, None, None] * corners
        values = self._run(self._field, probes.reshape(-1, 3), ()).astype(np.float64)
        return values.reshape(-1, 4) @ corners / (4.0 * step[:, None])

    def _run(self, function: Callable, points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Call `function` batch by batch and check what it returns."""
        results = np.empty((len(points), *shape), dtype=np.float32)
        for start in range(0, len(points), self._batch):
            part = np.asarray(points[start : start + self._batch], dtype=np.float32)
            rows = len(part)
            if rows < self._batch:
                part = np.concatenate([part, np.repeat(part[:1], self._batch - rows, axis=0)])
            answer = np.asarray(function(part))
            if answer.shape != (self._batch, *shape):
                raise ValueError(
                    f"the {'gradient' if shape else 'field'} must return {self._batch} values "
                    f"with shape {(self._batch, *shape)}, found {answer.shape}."
                )
            results[start : start + rows] = answer[:rows]
            with self._lock:
                self.count += rows
                if self._bar is not None:
                    self._bar.update(rows)
        if not np.isfinite(results).all():
            bad = ~np.isfinite(results).all(axis=tuple(range(1, results.ndim)))
            first = np.asarray(points)[bad][0]
            raise ValueError(
                f"the field is not finite at {int(bad.sum())} of {len(points)} points, first at "
                f"{first.tolist()}: check the weights of the field."
            )
        return results


def in_blocks(
    work: Callable[[slice], tuple[np.ndarray, ...]], count: int, rows: int
) -> tuple[np.ndarray, ...]:
    """Apply `work` to slices of `rows` of `count` rows; concatenate the arrays in order.

    Uses two threads: NumPy and compiled fields release the interpreter lock most of the time.
    """
    if count <= rows:
        return work(slice(0, count))
    slices = [slice(start, min(start + rows, count)) for start in range(0, count, rows)]
    with ThreadPoolExecutor(2) as pool:
        parts = pool.map(work, slices)
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True))
