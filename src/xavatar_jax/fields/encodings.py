"""Encodings of a point: sines and cosines, and multi-resolution feature grids."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .grids import CORNERS, lerp_weights


def positional_encoding(x: Float[Array, " n"], octaves: int) -> Float[Array, " m"]:
    """$[x, \\sin 2^0 x, \\cos 2^0 x, \\dots, \\cos 2^{L-1} x]$ with L `octaves`, raw input first.

    No factor of pi, as in X-Avatar's released code. Width n (1 + 2 L).
    """
    if octaves == 0:
        return x
    scaled = x[None, :] * (2.0 ** np.arange(octaves))[:, None].astype(x.dtype)
    waves = jnp.stack([jnp.sin(scaled), jnp.cos(scaled)], axis=1)
    return jnp.concatenate([x, waves.reshape(-1)])


# Large primes, one an axis, as in Instant NGP (Müller et al., SIGGRAPH 2022).
_PRIMES = np.array([1, 2654435761, 805459861], np.uint32)


class HashEncoding(eqx.Module):
    """Features from grids of rising resolution, read trilinearly (Instant NGP).

    Levels that fit in a table are stored densely, finer ones by a spatial hash. `spacing` gives
    the node distance of each level in metres; nodes lie on multiples of it, from `origin`.
    """

    table: Float[Array, "rows features"]
    origin: tuple[float, ...] = eqx.field(static=True)
    spacing: tuple[float, ...] = eqx.field(static=True)
    shapes: tuple[tuple[int, int, int] | None, ...] = eqx.field(static=True)
    offsets: tuple[int, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        low: Float[np.ndarray, "3"],
        high: Float[np.ndarray, "3"],
        *,
        spacing: tuple[float, ...],
        features: int = 2,
        log2_size: int = 17,
        scale: float = 1e-4,
        key: PRNGKeyArray,
    ):
        self.origin = tuple(float(v) for v in low)
        self.spacing = tuple(float(h) for h in spacing)
        shapes, sizes = [], []
        for h in self.spacing:
            nodes = tuple(int(n) for n in np.ceil((np.asarray(high) - low) / h).astype(int) + 2)
            dense = int(np.prod(nodes))
            shapes.append(nodes if dense <= 2**log2_size else None)
            sizes.append(min(dense, 2**log2_size))
        self.shapes = tuple(shapes)
        self.sizes = tuple(sizes)
        self.offsets = tuple(int(n) for n in np.cumsum([0, *sizes[:-1]]))
        rows = int(sum(sizes))
        self.table = jax.random.uniform(key, (rows, features), minval=-scale, maxval=scale)

    @property
    def width(self) -> int:
        """Features a point, of all levels together."""
        return len(self.spacing) * self.table.shape[1]

    def __call__(self, x: Float[Array, "3"]) -> Float[Array, "levels features"]:
        """Features of one point, by level. Outside the box the nearest nodes answer."""
        origin = jnp.asarray(self.origin, x.dtype)
        spacing = jnp.asarray(self.spacing, x.dtype)
        u = (x - origin)[None, :] / spacing[:, None]
        cell = jnp.floor(jax.lax.stop_gradient(u))
        fraction = u - cell
        corners = cell.astype(jnp.int32)[:, None, :] + CORNERS  # (levels, 8, 3)
        rows = jnp.stack([self._rows(level, corners[level]) for level in range(len(self.spacing))])
        return jnp.einsum("lc,lcf->lf", lerp_weights(fraction), self.table[rows])

    def _rows(self, level: int, corners: Array) -> Array:
        shape, size, offset = self.shapes[level], self.sizes[level], self.offsets[level]
        if shape is not None:
            i, j, k = (jnp.clip(corners[:, a], 0, shape[a] - 1) for a in range(3))
            return offset + (i * shape[1] + j) * shape[2] + k
        mixed = corners.astype(jnp.uint32) * _PRIMES
        mixed = mixed[:, 0] ^ mixed[:, 1] ^ mixed[:, 2]
        return offset + (mixed % np.uint32(size)).astype(jnp.int32)
