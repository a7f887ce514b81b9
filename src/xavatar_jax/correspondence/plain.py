"""The search as a definition: one root find a start, under `vmap`. The oracle of the fast paths."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..fields import AbstractSkinningField
from ..kinematics import inverse_3x3, skin_points, solve_3x3
from .broyden import Broyden
from .starts import check_bones

DIVERGENCE = 1.0  # metres; X-Avatar's released code


class Correspondences(eqx.Module):
    """Canonical points that skinning carries to one posed point, one for each start.

    - `x_c`: `(I, 3)` metres; meaningful where `found`.
    - `residual`: `(I,)` metres, at the point returned, found or not.
    - `found`: `(I,)` converged, and inside the field's cover.
    - `result`: `(I,)` the solver's cause, an `optimistix.RESULTS`.
    - `num_steps`: `(I,)`.
    """

    x_c: Float[Array, "I 3"]
    residual: Float[Array, " I"]
    found: Bool[Array, " I"]
    result: optx.RESULTS
    num_steps: Int[Array, " I"]


def find_correspondences(
    x_d: Float[Array, "3"],
    field: AbstractSkinningField,
    transforms: Float[Array, "J 4 4"],
    *,
    init_bones: tuple[int, ...],
    solver: optx.AbstractRootFinder | None = None,
    adjoint: optx.AbstractAdjoint | None = None,
    max_steps: int = 50,
    throw: bool = False,
) -> Correspondences:
    r"""Find the canonical points that skinning carries to one posed point.

    Solves $d(x_c) - x_d = 0$ with $d(x_c) = \sum_i w_i(x_c) B_i x_c$, once from each start
    $B_i^{-1} x_d$. Several roots may exist (an arm on the torso); all are returned. Use
    `jax.vmap` for many points.

    - `field`: maps a canonical point to weights over the J bones.
    - `transforms`: $B_i$, rigid up to one scale, canonical to posed, metres.
    - `init_bones`: bones whose pull-backs start the search; see `part_groups`.
    - `solver`: by default `Broyden(atol=1e-5, divergence=1.0)` with the exact inverse Jacobian
      at the start. `atol` is in metres.
    - `adjoint`: how derivatives pass the solve; by default the implicit function theorem, with
      derivatives for field, transforms and `x_d`, and none where nothing was found.
    - `throw`: raise if any start fails; by default failures are reported in `result`.

    **Raises:** `ValueError` when tracing if `init_bones` is empty or out of range, or a shape is
    wrong.

    Source: SNARF (Chen et al., ICCV 2021) for the search, X-Avatar (CVPR 2023) for the starts.
    """
    if x_d.shape != (3,):
        raise ValueError(f"x_d has shape {x_d.shape}, expected (3,); use jax.vmap for many points")
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4):
        raise ValueError(f"transforms have shape {transforms.shape}, expected (J, 4, 4)")
    check_bones(init_bones, transforms.shape[0])
    solver = Broyden(atol=1e-5, divergence=DIVERGENCE) if solver is None else solver
    bones = np.asarray(init_bones)
    dynamic, static = eqx.partition(field, eqx.is_array)

    def residual(x: Array, args: tuple) -> Array:
        leaves, transforms, x_d = args
        return skin_points(x, eqx.combine(leaves, static)(x), transforms) - x_d

    args = (dynamic, transforms, x_d)

    def solve(start: Array) -> tuple[Array, Array, Array, optx.RESULTS, Array]:
        options = {}
        if isinstance(solver, Broyden):
            jacobian = jax.jacfwd(residual)(start, jax.lax.stop_gradient(args))
            options["inverse_jacobian"] = inverse_3x3(jacobian)
        solution = optx.root_find(
            residual,
            solver,
            start,
            jax.lax.stop_gradient(args) if adjoint is None else args,
            options,
            max_steps=max_steps,
            adjoint=optx.ImplicitAdjoint() if adjoint is None else adjoint,
            throw=throw,
        )
        # Masked here, inside the mapped function: derivatives of a failed solve would be finite
        # and wrong.
        ok = solution.result == optx.RESULTS.successful
        x_c = jnp.where(ok, solution.value, jax.lax.stop_gradient(solution.value))
        if adjoint is None:
            x_c = with_derivatives(x_c, ok)
        error = residual(jax.lax.stop_gradient(x_c), jax.lax.stop_gradient(args))
        found = ok & field.covers(jax.lax.stop_gradient(x_c))
        return x_c, jnp.sqrt(jnp.sum(error**2)), found, solution.result, solution.stats["num_steps"]

    def with_derivatives(root: Array, ok: Array) -> Array:
        # A linear solver would raise at a start that met NaN or a fold: those lanes stand in with
        # a harmless point and pass on nothing.
        place = jnp.where(ok, jax.lax.stop_gradient(root), 0.0)
        safe_args = (dynamic, transforms, jnp.where(ok, x_d, 0.0))
        error = residual(place, safe_args)
        jacobian = jax.jacfwd(residual)(place, jax.lax.stop_gradient(safe_args))
        usable = ok & jnp.all(jnp.isfinite(inverse_3x3(jacobian)))
        safe = jnp.where(usable, jacobian, jnp.eye(3, dtype=jacobian.dtype))
        step = solve_3x3(safe, error - jax.lax.stop_gradient(error))
        return jnp.where(usable, place - step, root)

    starts = jax.lax.stop_gradient(pull_back(x_d, transforms[bones]))
    return Correspondences(*jax.vmap(solve)(starts))


def pull_back(x_d: Float[Array, "3"], transforms: Float[Array, "I 4 4"]) -> Float[Array, "I 3"]:
    """$B_i^{-1} x_d$ for each bone: where a point would be if it belonged to that bone alone."""
    linear = transforms[..., :3, :3]
    return solve_3x3(linear, x_d - transforms[..., :3, 3])
