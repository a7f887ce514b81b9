"""What expressions change, place by place: features on a grid around the face."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .grids import CORNERS, lerp_weights

# A box fades out over its last centimetres, so that the field has no edge there.
_FADE_M = 0.02
_EXACT = jax.lax.Precision.HIGHEST


class ExpressionGrid(eqx.Module):
    """K features of a point that are linear in the E expression coefficients, as blend shapes are.

    Every node of a regular grid has E x K numbers, read trilinearly: the mouth and the brows learn
    apart. Silent outside its box, and at first everywhere.
    """

    table: Float[Array, "N E K"]
    low: tuple[float, float, float] = eqx.field(static=True)
    spacing: float = eqx.field(static=True)
    shape: tuple[int, int, int] = eqx.field(static=True)

    def __init__(
        self,
        low: Float[np.ndarray, "3"],
        high: Float[np.ndarray, "3"],
        *,
        spacing: float,
        num_expression: int,
        features: int,
    ):
        x, y, z = (int(n) for n in np.ceil((np.asarray(high) - low) / spacing) + 1)
        self.low = (float(low[0]), float(low[1]), float(low[2]))
        self.spacing, self.shape = spacing, (x, y, z)
        self.table = jnp.zeros((x * y * z, num_expression, features))

    @property
    def nodes(self) -> Float[np.ndarray, "N 3"]:
        """Places of the nodes, metres, in the order of the table."""
        axes = [
            low + self.spacing * np.arange(n) for low, n in zip(self.low, self.shape, strict=True)
        ]
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

    def _around(self, x: Float[Array, "3"]) -> tuple[Int[Array, "8"], Float[Array, "8"]]:
        """The nodes of a point's cell, and the share of each: all zero outside the box."""
        u = (x - jnp.asarray(self.low, x.dtype)) / self.spacing
        last = jnp.asarray(self.shape, x.dtype) - 1
        depth = self.spacing * jnp.minimum(u, last - u).min()
        cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(u)), 0, last - 1)
        fraction = jnp.clip(u - cell, 0, 1)
        corners = cell.astype(jnp.int32) + CORNERS
        rows = (corners[:, 0] * self.shape[1] + corners[:, 1]) * self.shape[2] + corners[:, 2]
        return rows, lerp_weights(fraction) * jnp.clip(depth / _FADE_M, 0, 1)
