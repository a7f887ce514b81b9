"""Distinct roots of many points, out of all that their starts came to."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Roots closer than this are one root found twice: ten times the search's tolerance and more.
SAME_ROOT = 5e-4


class Outcome(eqx.Enumeration):
    """What became of the search for one point."""

    found = "at least one root"
    not_finite = "the point is not finite"
    bad_transforms = "a bone transform is not a rotation, one scale and a translation"
    no_start = "no bone starts the search for a point of this part"
    outside = "every start that converged did so outside the field's cover"
    diverged = "every start ran away"
    not_converged = "no start converged within the steps allowed"


class Roots(eqx.Module):
    """Distinct roots of P posed points, at most K each.

    - `x_c`: `(P, K, 3)` metres; meaningful where `valid`.
    - `valid`: `(P, K)`; `residual`: `(P, K)` metres, infinite where not valid.
    - `outcome`: `(P,)` an `Outcome`; `more`: `(P,)` roots beyond K were found and dropped.
    - `steps`: solver steps in all, and `lanes` the starts that took them.
    """

    x_c: Float[Array, "P K 3"]
    valid: Bool[Array, "P K"]
    residual: Float[Array, "P K"]
    outcome: Outcome
    more: Bool[Array, " P"]
    steps: Int[Array, ""]
    lanes: Int[Array, ""]


def distinct_roots(
    x_c: Float[Array, "P I 3"],
    residual: Float[Array, "P I"],
    valid: Bool[Array, "P I"],
    keep: int,
) -> tuple[Float[Array, "P K 3"], Float[Array, "P K"], Bool[Array, "P K"], Bool[Array, " P"]]:
    """The first `keep` valid candidates that are no repetition: roots, residuals, valid, more."""
    left = valid
    rows = []
    for _ in range(min(keep, valid.shape[1])):
        first = jnp.argmax(left, axis=1)[:, None]
        there = jnp.take_along_axis(left, first, axis=1)[:, 0]
        root = jnp.take_along_axis(x_c, first[..., None], axis=1)[:, 0]
        error = jnp.take_along_axis(residual, first, axis=1)[:, 0]
        # Coordinates apart: the compiler then works on whole rows of points.
        apart = sum(((x_c[..., k] - root[:, None, k]) ** 2 for k in range(3)), jnp.zeros(()))
        left = left & ~(apart < SAME_ROOT**2)
        rows.append((root, jnp.where(there, error, jnp.inf), there))
    roots, errors, found = (jnp.stack(column, axis=1) for column in zip(*rows, strict=True))
    return roots, errors, found, jnp.any(left, axis=1)


def outcomes(
    x_d: Float[Array, "P 3"],
    rigid: Bool[Array, ""],
    started: Bool[Array, "P I"],
    residual: Float[Array, "P I"],
    converged: Bool[Array, "P I"],
    valid: Bool[Array, "P I"],
    divergence: float,
) -> Outcome:
    """The cause for each point, of all its starts."""

    def of_point(x: Array, started: Array, residual: Array, converged: Array, valid: Array):
        ran_away = jnp.all(~started | ~(residual < divergence))
        causes = (  # the first that holds
            (~jnp.all(jnp.isfinite(x)), Outcome.not_finite),
            (~rigid, Outcome.bad_transforms),
            (~jnp.any(started), Outcome.no_start),
            (jnp.any(valid), Outcome.found),
            (jnp.any(converged), Outcome.outside),
            (ran_away, Outcome.diverged),
        )
        answer = Outcome.not_converged
        for holds, cause in reversed(causes):
            answer = Outcome.where(holds, cause, answer)
        return answer

    return jax.vmap(of_point)(x_d, started, residual, converged, valid)
