"""Links: what the level of a geometry field means."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractLink(eqx.Module):
    """Turns levels of a geometry field into losses, probabilities and distances.

    The surface is where the level is 0, and the level is larger inside. Distances are signed
    metres, positive inside.
    """

    @abc.abstractmethod
    def loss(self, level: Float[Array, "*n"], distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Loss of each level at a point whose signed distance is known. It is 0 at best."""

    @abc.abstractmethod
    def inside_loss(self, level: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Loss of each level at a point that is inside, at an unknown depth."""

    @abc.abstractmethod
    def probability(self, level: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Probability that a point is inside."""

    @property
    @abc.abstractmethod
    def outside(self) -> float:
        """A level that is clearly outside, for points at which there is no field."""

    def distance(
        self, level: Float[Array, "*n"], slope: Float[Array, "*n 3"]
    ) -> Float[Array, "*n"]:
        """Signed distance to the surface, to first order, from the level and its gradient."""
        # The square root's derivative has to exist where the gradient vanishes.
        return level / jnp.sqrt(jnp.sum(slope**2, axis=-1) + 1e-12)


class Occupancy(AbstractLink):
    """The level is the logit of occupancy, learned by binary cross-entropy.

    `softness` is the width of the target's step at the surface in metres: its occupancy is
    $\\sigma(d / s)$, so the best logit is $d / s$ and a single point near the surface tells where
    the surface is, not only on which side. With `softness=0` targets are 0 or 1.
    """

    softness: float = eqx.field(static=True, default=0.004)

    def loss(self, level: Float[Array, "*n"], distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        if self.softness == 0:
            return binary_cross_entropy(level, (distance > 0).astype(level.dtype))
        best = distance / self.softness
        target = jax.nn.sigmoid(best)
        return binary_cross_entropy(level, target) - binary_cross_entropy(best, target)

    def inside_loss(self, level: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return jax.nn.softplus(-level)

    def probability(self, level: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return jax.nn.sigmoid(level)

    @property
    def outside(self) -> float:
        return -10.0  # a probability of 5e-5


class SignedDistance(AbstractLink):
    """The level is the signed distance in metres, learned by its absolute error.

    `softness` is the width in metres over which the probability rises at the surface (0: a step).
    """

    softness: float = eqx.field(static=True, default=0.004)

    def loss(self, level: Float[Array, "*n"], distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return jnp.abs(level - distance)

    def inside_loss(self, level: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return jax.nn.relu(-level)

    def probability(self, level: Float[Array, "*n"]) -> Float[Array, "*n"]:
        if self.softness == 0:
            return (level > 0).astype(level.dtype)
        return jax.nn.sigmoid(level / self.softness)

    @property
    def outside(self) -> float:
        return -0.1  # metres: beyond the band in which fields are read


def binary_cross_entropy(
    logit: Float[Array, "*n"], target: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """$-y \\log\\sigma(z) - (1 - y) \\log(1 - \\sigma(z))$ for targets in [0, 1].

    Stable for any logit. **Raises:** `ValueError` if the shapes differ.
    """
    if logit.shape != target.shape:
        raise ValueError(f"shapes differ: {logit.shape} and {target.shape}")
    # Not max(z, 0) + log1p(exp(-|z|)): its derivative at zero is not that of the loss.
    return jax.nn.softplus(logit) - logit * target
