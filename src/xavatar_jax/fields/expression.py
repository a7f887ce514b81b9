"""What expressions change, place by place: features on a grid around the face."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# A box fades out over its last centimetres, so that the field has no edge there.
_FADE_M = 0.02
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.int32)


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

    def __call__(self, x: Float[Array, "3"]) -> Float[Array, "E K"]:
        u = (x - jnp.asarray(self.low, x.dtype)) / self.spacing
        last = jnp.asarray(self.shape, x.dtype) - 1
        depth = self.spacing * jnp.minimum(u, last - u).min()
        cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(u)), 0, last - 1)
        fraction = jnp.clip(u - cell, 0, 1)
        corners = cell.astype(jnp.int32) + _CORNERS
        rows = (corners[:, 0] * self.shape[1] + corners[:, 1]) * self.shape[2] + corners[:, 2]
        share = jnp.where(_CORNERS == 1, fraction, 1 - fraction).prod(-1)
        share = share * jnp.clip(depth / _FADE_M, 0, 1)
        return jnp.einsum("c,cek->ek", share, self.table[rows])
