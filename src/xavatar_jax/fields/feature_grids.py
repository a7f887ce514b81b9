"""Learned features on regular grids: multi-resolution hash grids, and the effect of expression."""

from __future__ import annotations

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .grids import CORNERS, lerp, lerp_weights
from .roles import misshapen, stored

# Large primes, one an axis, as in Instant NGP (Müller et al., SIGGRAPH 2022).
_PRIMES = np.array([1, 2654435761, 805459861], np.uint32)


class HashEncoding(eqx.Module):
    """Features from grids of rising resolution, read trilinearly (Instant NGP).

    `spacing` is the node distance of each level in metres; nodes lie on multiples of it from
    `origin`. Level l has the rows from `offsets[l]` to `offsets[l + 1]`. A level that fits into
    `2**log2_size` rows is stored densely, with `shapes[l]` nodes an axis; a finer one by a spatial
    hash, and its shape is zero.
    """

    table: Float[Array, "rows features"]
    origin: Float[Array, "3"] = stored()
    shapes: Int[Array, "levels 3"] = stored()
    offsets: Int[Array, " levels+1"] = stored()
    spacing: tuple[float, ...] = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]

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
        self.spacing = tuple(float(h) for h in spacing)
        steps = np.asarray(self.spacing)[:, None]
        nodes = np.ceil((np.asarray(high) - low) / steps).astype(np.int64) + 2
        count = nodes.prod(1)
        most = 2**log2_size
        offsets = np.cumsum([0, *np.minimum(count, most)])
        self.origin = jnp.asarray(low, jnp.zeros(0).dtype)
        self.shapes = jnp.asarray(np.where(count[:, None] <= most, nodes, 0), jnp.int32)
        self.offsets = jnp.asarray(offsets, jnp.int32)
        shape = (int(offsets[-1]), features)
        self.table = jax.random.uniform(key, shape, minval=-scale, maxval=scale)

    @property
    def width(self) -> int:
        """Features a point, of all levels together."""
        return len(self.spacing) * self.table.shape[1]

    def __call__(self, x: Float[Array, "3"]) -> Float[Array, "levels features"]:
        """Features of one point, by level. Outside the box the nearest nodes answer."""
        spacing = jnp.asarray(self.spacing, x.dtype)
        u = (x - jax.lax.stop_gradient(self.origin).astype(x.dtype)) / spacing[:, None]
        cell = jnp.floor(jax.lax.stop_gradient(u))
        fraction = u - cell
        corners = cell.astype(jnp.int32)[:, None, :] + CORNERS  # (levels, 8, 3)
        return lerp(fraction, self.table[self._rows(corners)])

    def faults(self) -> Iterator[tuple[str, str]]:
        """Leaves that do not fit one another: see `check_model`."""
        levels = len(self.spacing)
        yield from misshapen(self, origin=(3,), shapes=(levels, 3), offsets=(levels + 1,))
        offsets, shapes = np.asarray(self.offsets), np.asarray(self.shapes, np.int64)
        yield from misshapen(self, table=(int(offsets[-1]), None))
        rows, dense = np.diff(offsets), shapes.prod(1)
        whole = np.where(dense > 0, rows == dense, (rows > 0) & (rows & (rows - 1) == 0))
        if offsets[0] != 0 or not whole.all():
            yield "offsets", f"{offsets.tolist()} do not fit shapes {shapes.tolist()}"

    def _rows(self, corners: Int[Array, "levels 8 3"]) -> Int[Array, "levels 8"]:
        shape = self.shapes[:, None, :]
        i, j, k = jnp.moveaxis(jnp.clip(corners, 0, shape - 1), -1, 0)
        dense = (i * shape[..., 1] + j) * shape[..., 2] + k
        mixed = corners.astype(jnp.uint32) * _PRIMES
        mixed = mixed[..., 0] ^ mixed[..., 1] ^ mixed[..., 2]
        # A hashed level has a power of two rows: a mask, since vector code cannot divide integers.
        last = (self.offsets[1:] - self.offsets[:-1] - 1)[:, None]
        hashed = mixed.astype(jnp.int32) & last
        return self.offsets[:-1, None] + jnp.where(shape[..., 0] > 0, dense, hashed)


# A box fades out over its last centimetres, so that the field has no edge there.
_FADE_M = 0.02
_EXACT = jax.lax.Precision.HIGHEST


class ExpressionGrid(eqx.Module):
    """K features of a point that are linear in the E expression coefficients, as blend shapes are.

    Every node of a regular grid has E x K numbers, read trilinearly: the mouth and the brows learn
    apart. Silent outside its box, and at first everywhere.
    """

    table: Float[Array, "N E K"]
    low: Float[Array, "3"] = stored()
    shape: Int[Array, "3"] = stored()
    spacing: float = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]

    def __init__(
        self,
        low: Float[np.ndarray, "3"],
        high: Float[np.ndarray, "3"],
        *,
        spacing: float,
        num_expression: int,
        features: int,
    ):
        shape = np.ceil((np.asarray(high) - low) / spacing).astype(int) + 1
        self.low, self.shape = jnp.asarray(low, jnp.zeros(0).dtype), jnp.asarray(shape, jnp.int32)
        self.spacing = spacing
        self.table = jnp.zeros((int(shape.prod()), num_expression, features))

    @property
    def nodes(self) -> Float[np.ndarray, "N 3"]:
        """Places of the nodes, metres, in the order of the table."""
        low, shape = np.asarray(self.low, np.float64), np.asarray(self.shape)
        axes = [low[k] + self.spacing * np.arange(shape[k]) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def __call__(self, x: Float[Array, "3"]) -> Float[Array, "E K"]:
        rows, share = self._around(x)
        return jnp.einsum("c,cek->ek", share, self.table[rows])

    def under(self, expression: Float[Array, " E"]) -> Float[Array, "N K"]:
        """The nodes' features under one expression, for `read`: no work of any one point's."""
        return jnp.einsum("nek,e->nk", self.table, expression, precision=_EXACT)

    def read(self, nodes: Float[Array, "N K"], x: Float[Array, "3"]) -> Float[Array, " K"]:
        """Features of a point under the expression of `nodes`."""
        rows, share = self._around(x)
        return share @ nodes[rows]

    def faults(self) -> Iterator[tuple[str, str]]:
        """Leaves that do not fit one another: see `check_model`."""
        yield from misshapen(self, low=(3,), shape=(3,))
        yield from misshapen(self, table=(int(np.prod(np.asarray(self.shape))), None, None))

    def read_with_jacobian(
        self, nodes: Float[Array, "N 3"], x: Float[Array, "3"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """`read` of three features, and its derivative with respect to the point."""
        u, last, cell = self._cell(x)
        corner = nodes[self._rows(cell)]
        f = jnp.clip(u - cell, 0, 1)
        # Written out by corner and axis, which a CPU's compiler turns into vector code over points.
        lerp = [(1 - f[k], f[k]) for k in range(3)]
        value, slopes = jnp.zeros_like(x), [jnp.zeros_like(x) for _ in range(3)]
        for c, (i, j, k) in enumerate(CORNERS.tolist()):
            wx, wy, wz = lerp[0][i], lerp[1][j], lerp[2][k]
            value = value + wx * wy * wz * corner[c]
            for axis, (side, share) in enumerate(((i, wy * wz), (j, wx * wz), (k, wx * wy))):
                slopes[axis] = slopes[axis] + (share if side else -share) * corner[c]
        depth = jnp.minimum(u, last - u)
        nearest = depth <= jnp.min(depth)
        fade = self.spacing * jnp.min(depth) / _FADE_M
        fading = nearest & (fade > 0) & (fade < 1)
        slope = jnp.where(fading, jnp.where(u < last - u, 1.0, -1.0) / _FADE_M, 0.0).astype(x.dtype)
        fade = jnp.clip(fade, 0, 1)
        jacobian = jnp.stack(slopes, axis=-1) * (fade / self.spacing)
        return fade * value, jacobian + value[:, None] * slope

    def _around(self, x: Float[Array, "3"]) -> tuple[Int[Array, "8"], Float[Array, "8"]]:
        """The nodes of a point's cell, and the share of each: all zero outside the box."""
        u, last, cell = self._cell(x)
        depth = self.spacing * jnp.minimum(u, last - u).min()
        fraction = jnp.clip(u - cell, 0, 1)
        return self._rows(cell), lerp_weights(fraction) * jnp.clip(depth / _FADE_M, 0, 1)

    def _cell(self, x: Float[Array, "3"]) -> tuple[Float[Array, "3"], ...]:
        """A point in units of the spacing, the grid's last node, and the lowest of its cell."""
        u = (x - jax.lax.stop_gradient(self.low).astype(x.dtype)) / self.spacing
        last = self.shape.astype(x.dtype) - 1
        return u, last, jnp.clip(jnp.floor(jax.lax.stop_gradient(u)), 0, last - 1)

    def _rows(self, cell: Float[Array, "3"]) -> Int[Array, "8"]:
        i, j, k = (cell.astype(jnp.int32) + CORNERS).T
        return (i * self.shape[1] + j) * self.shape[2] + k
