"""Geometry fields at points that stay where they are, while the condition changes."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .softplus import softplus

_BATCH = 4096
_EXACT = jax.lax.Precision.HIGHEST


class AbstractFixedPoints(eqx.Module):
    """A geometry field at N fixed points: logits for one frame's condition after another."""

    @abc.abstractmethod
    def __call__(self, condition: Any) -> Float[Array, " N"]:
        """Logits at the points under one condition, as the field itself gives them."""


class FixedPoints(AbstractFixedPoints):
    """Any field: evaluated anew for each condition, some thousand points at a time."""

    field: Callable[[Array, Any], Array]
    points: Float[Array, "N 3"]

    def __call__(self, condition: Any) -> Float[Array, " N"]:
        count = len(self.points)
        padded = jnp.pad(self.points, ((0, -count % _BATCH), (0, 0)))
        each = jax.vmap(lambda x: self.field(x, condition))
        return jax.lax.map(each, padded.reshape(-1, _BATCH, 3)).reshape(-1)[:count]


class FixedHash(AbstractFixedPoints):
    """A hash field: of its grids only what the first layer makes of them is kept.

    For each condition there remain a product with the points' nearness to the joints and the
    small network.
    """

    first: Float[Array, "N width"]
    nearness: Float[Array, "N J"]
    expressive: Float[Array, "N E K2"] | None
    from_condition: Float[Array, "width K1"]
    hidden: tuple[Float[Array, "out in"], ...]
    biases: tuple[Float[Array, " out"], ...]
    sharpness: float = eqx.field(static=True)

    def __call__(self, condition: Any) -> Float[Array, " N"]:
        joints, expression = condition.joints, condition.expression
        weight, width = self.from_condition, joints.shape[-1]
        h = self.first + _matmul(self.nearness, _matmul(joints, weight[:, :width].T))
        if self.expressive is not None:
            heard = jnp.einsum("nek,e->nk", self.expressive, expression, precision=_EXACT)
            h = h + _matmul(heard, weight[:, width:].T)
        for weight, bias in zip(self.hidden, self.biases, strict=True):
            h = _matmul(softplus(h, self.sharpness), weight.T) + bias
        return h[:, 0]


def _matmul(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=_EXACT)
