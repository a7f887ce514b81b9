"""The reference search: one root find per start, under `vmap`. Tests compare the others to it."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..fields import AbstractSkinningField
from ..kinematics import inverse_3x3, skin_points, solve_3x3
from .implicit import newton_step
from .root_finders import Broyden
from .starts import check_bones

DIVERGENCE = 1.0  # metres; X-Avatar's released code


class Correspondences(eqx.Module):
    """Canonical points that skinning carries to one posed point, one for each start.

    - `x_c`: `(I, 3)` metres; meaningful where `found`.
    - `residual`: `(I,)` metres, at the returned point, found or not.
    - `found`: `(I,)` converged, and in the region that the field covers.
    - `result`: `(I,)` an `optimistix.RESULTS`.
    - `num_steps`: `(I,)`.
    """

    x_c: Float[Array, "I 3"]
    residual: Float[Array, " I"]
    found: Bool[Array, " I"]
    result: optx.RESULTS
    num_steps: Int[Array, " I"]


def find_correspondences(
    x_d: Float[Array, "3"],
    field: Callable[[Float[Array, "3"]], Float[Array, " J"]],
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

    - `field`: maps a canonical point to weights over the J bones: a skinning field, or any
      function.
    - `transforms`: $B_i$, rigid up to one scale, canonical to posed, metres.
    - `init_bones`: bones whose pull-backs start the search; see `part_groups`.
    - `solver`: by default `Broyden(atol=1e-5, divergence=1.0)` with the exact inverse Jacobian
      at the start. `atol` is in metres.
    - `adjoint`: by default, or as `optimistix.ImplicitAdjoint()`, the implicit function theorem
      with derivatives for field, transforms and `x_d`, and none where nothing was found or the
      root is not regular (`is_regular`). Other adjoints differentiate the solver's steps.
    - `throw`: raise an error at run time if a solve fails.

    **Raises:** `ValueError` when tracing for wrong shapes, or if `init_bones` is empty or out of
    range.

    Source: SNARF (Chen et al., ICCV 2021) for the search, X-Avatar (CVPR 2023) for the starts.
    """
    x_d, transforms = jnp.asarray(x_d), jnp.asarray(transforms)
    if x_d.shape != (3,):
        raise ValueError(f"x_d has shape {x_d.shape}, expected (3,). Use jax.vmap for many points.")
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4):
        raise ValueError(f"transforms have shape {transforms.shape}, expected (J, 4, 4)")
    check_bones(init_bones, transforms.shape[0])
    solver = Broyden(atol=1e-5, divergence=DIVERGENCE) if solver is None else solver
    bones = np.asarray(init_bones)
    covers = field.covers if isinstance(field, AbstractSkinningField) else _everywhere
    if not isinstance(field, eqx.Module):  # arrays that a function closes over become leaves
        field = eqx.filter_closure_convert(field, x_d)
    dynamic, static = eqx.partition(field, eqx.is_array)
    implicit = adjoint is None or isinstance(adjoint, optx.ImplicitAdjoint)

    def residual(x: Array, args: tuple) -> Array:
        leaves, transforms, x_d = args
        return skin_points(x, eqx.combine(leaves, static)(x), transforms) - x_d

    args = (dynamic, transforms, x_d)
    fixed = jax.lax.stop_gradient(args)

    def solve(start: Array) -> tuple[Array, Array, Array, optx.RESULTS, Array]:
        options = {}
        if isinstance(solver, Broyden):
            options["inverse_jacobian"] = inverse_3x3(jax.jacfwd(residual)(start, fixed))
        solution = optx.root_find(
            residual,
            solver,
            start,
            fixed if implicit else args,
            options,
            max_steps=max_steps,
            adjoint=optx.ImplicitAdjoint() if implicit else adjoint,  # pyright: ignore[reportArgumentType]
            throw=throw,
        )
        # Mask inside the mapped function: derivatives of a failed solve are finite and wrong.
        ok = solution.result == optx.RESULTS.successful
        x_c = jnp.where(ok, solution.value, jax.lax.stop_gradient(solution.value))
        if implicit:
            x_c = with_derivatives(x_c, ok)
        held = jax.lax.stop_gradient(x_c)
        error = residual(held, fixed)
        found = ok & covers(held)
        return x_c, jnp.sqrt(jnp.sum(error**2)), found, solution.result, solution.stats["num_steps"]

    def with_derivatives(root: Array, ok: Array) -> Array:
        # Failed lanes use a dummy point; their gradient is zero.
        place = jnp.where(ok, jax.lax.stop_gradient(root), 0.0)
        safe = (dynamic, transforms, jnp.where(ok, x_d, 0.0))
        error = residual(place, safe)
        jacobian = jax.jacfwd(residual)(place, jax.lax.stop_gradient(safe))
        step, regular = newton_step(jacobian, error - jax.lax.stop_gradient(error), ok)
        return jnp.where(regular, place - step, jax.lax.stop_gradient(root))

    starts = jax.lax.stop_gradient(pull_back(x_d, transforms[bones]))
    return Correspondences(*jax.vmap(solve)(starts))


def _everywhere(x: Float[Array, "3"]) -> Bool[Array, ""]:
    return jnp.all(jnp.isfinite(x))


def pull_back(x_d: Float[Array, "3"], transforms: Float[Array, "I 4 4"]) -> Float[Array, "I 3"]:
    """$B_i^{-1} x_d$ for each bone: where a point would be if it belonged to that bone alone."""
    linear = transforms[..., :3, :3]
    return solve_3x3(linear, x_d - transforms[..., :3, 3])
