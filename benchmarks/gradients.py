"""Derivatives of roots: implicit, through unrolled iterations, and by finite differences.

Questions: do implicit derivatives agree with finite differences, with respect to the field's
parameters, the bone transforms and the posed point, in forward and reverse mode? What do they cost
compared with differentiating the iterations? What is the error of float32?

The field is the paper's network on randomly posed bodies. Roots are solved to 1e-12 in float64.
Each derivative is taken along one random direction. Its relative error is the norm of the
difference divided by the norm of the finite difference.

    python benchmarks/gradients.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from measuring import least_time, print_rows, write_result
from search_problems import FULL_PREFIT, QUICK_PREFIT, hard_problems, paper_field

import xavatar_jax as xa
from xavatar_jax.correspondence import (
    MIN_DETERMINANT,
    Broyden,
    find_correspondences,
    implicit_root,
    search_field,
    start_table,
)
from xavatar_jax.fields import (
    AbstractSkinningField,
    grid_vertices,
    skin_with_jacobian,
)
from xavatar_jax.kinematics import determinant_3x3, inverse_3x3, skin_points, solve_3x3
from xavatar_jax.report import describe_machine

VARIED = ("field", "transforms", "point")
UNROLLED_STEPS = {"newton": 12, "broyden": 30}
# Step sizes of central differences; two of them are combined to cancel third-order errors.
STEP = {"field": 1e-5, "transforms": 1e-5, "point": 2e-6}


class Case:
    """Roots of one field and several frames, in the enabled precision."""

    def __init__(self, field: Any, problems: list, count: int, seed: int):
        rng = np.random.default_rng([seed, 4])
        self.leaves, self.static = eqx.partition(field, eqx.is_inexact_array)
        real = jnp.zeros(()).dtype
        self.leaves = jax.tree.map(lambda v: jnp.asarray(v, real), self.leaves)
        each = count // len(problems)
        starts, targets, transforms = [], [], []
        for p in problems:
            rows = np.sort(rng.choice(len(p.x_c), each, replace=False))
            starts.append(np.asarray(p.x_c)[rows])
            targets.append(np.asarray(p.x_d)[rows])
            transforms.append(np.repeat(np.asarray(p.transforms)[None], each, 0))
        self.start, self.x_d, self.transforms = (
            jnp.asarray(np.concatenate(v), real) for v in (starts, targets, transforms)
        )
        directions = jax.tree.map(lambda v: rng.standard_normal(v.shape), self.leaves)
        size = np.sqrt(sum((v**2).sum() for v in jax.tree.leaves(directions)))
        length = np.sqrt(sum(float((v**2).sum()) for v in jax.tree.leaves(self.leaves)))
        field_direction = jax.tree.map(lambda v: jnp.asarray(v * length / size, real), directions)
        turn = rng.standard_normal((each * len(problems), *self.transforms.shape[1:])) * 0.1
        turn[:, :, 3] = 0.0
        step = rng.standard_normal(self.x_d.shape)
        self.direction = {
            "field": field_direction,
            "transforms": jnp.asarray(turn, real),
            "point": jnp.asarray(step, real),
        }
        self.cotangent = jnp.asarray(rng.standard_normal(self.x_d.shape), real)

    def field(self, leaves: Any) -> Any:
        return eqx.combine(leaves, self.static)

    def moved(self, varied: str, by: Array) -> tuple[Any, Array, Array]:
        """Parameters, transforms and points, with one of them moved along its direction."""
        args = {"field": self.leaves, "transforms": self.transforms, "point": self.x_d}
        args[varied] = jax.tree.map(lambda v, d: v + by * d, args[varied], self.direction[varied])
        return args["field"], args["transforms"], args["point"]


def residual(case: Case, leaves: Any, x: Array, x_d: Array, transforms: Array) -> Array:
    return skin_points(x, case.field(leaves)(x), transforms) - x_d


def newton_roots(case: Case, start: Array, leaves: Any, transforms: Array, x_d: Array, steps: int):
    """Newton's method from each start, a fixed number of steps."""

    def one(x: Array, x_d: Array, b: Array) -> Array:
        def step(x: Array, _: Any) -> tuple[Array, None]:
            posed, jacobian, _ = skin_with_jacobian(case.field(leaves), x, b)
            return x - solve_3x3(jacobian, posed - x_d), None

        return jax.lax.scan(step, x, length=steps)[0]

    return jax.vmap(one)(start, x_d, transforms)


def broyden_roots(case: Case, start: Array, leaves: Any, transforms: Array, x_d: Array, steps: int):
    """Broyden's method from each start; converged lanes stay fixed."""
    tolerance = 1e-12 if start.dtype == jnp.float64 else 1e-6

    def one(x: Array, x_d: Array, b: Array) -> Array:
        fn = lambda x: residual(case, leaves, x, x_d, b)  # noqa: E731
        inverse = inverse_3x3(jax.jacfwd(fn)(x))

        def step(state: tuple, _: Any) -> tuple[tuple, None]:
            x, error, inverse = state
            going = jnp.sum(error**2) > tolerance**2
            move = jnp.where(going, -(inverse * error).sum(-1), 0.0)
            new = fn(x + move)
            change = jnp.where(going, new - error, 1.0)
            row = (inverse.T * move).sum(-1)
            below = jnp.where(going, (row * change).sum(), 1.0)
            update = ((move - (inverse * change).sum(-1)) / below)[:, None] * row[None]
            keep = lambda a, b: jnp.where(going, a, b)  # noqa: E731
            return (x + move, keep(new, error), keep(inverse + update, inverse)), None

        return jax.lax.scan(step, (x, fn(x), inverse), length=steps)[0][0]

    return jax.vmap(one)(start, x_d, transforms)


def methods(
    case: Case, root: Array, atol: float
) -> dict[str, Callable[[Any, Array, Array], Array]]:
    """Roots as functions of parameters, transforms and points."""

    def implicit(leaves: Any, transforms: Array, x_d: Array) -> Array:
        one = lambda x, p, b: implicit_root(x, p, case.field(leaves), b)[0]  # noqa: E731
        return jax.vmap(one)(root, x_d, transforms)

    def plain(leaves: Any, transforms: Array, x_d: Array) -> Array:
        # Start from the root itself, which no bone's inverse transform need lead to: an extra
        # bone without weight provides this start.
        def one(x: Array, p: Array, b: Array) -> Array:
            field = Anchored(case.field(leaves))
            still = (
                jnp.eye(4, dtype=b.dtype)
                .at[:3, 3]
                .set(jax.lax.stop_gradient(p) - jax.lax.stop_gradient(x))
            )
            found = find_correspondences(
                p, field, jnp.concatenate([b, still[None]]),
                init_bones=(len(b),), solver=Broyden(atol=atol, divergence=1.0),
            )  # fmt: skip
            return found.x_c[0]

        return jax.vmap(one)(root, x_d, transforms)

    def newton(leaves: Any, transforms: Array, x_d: Array) -> Array:
        return newton_roots(case, case.start, leaves, transforms, x_d, UNROLLED_STEPS["newton"])

    def broyden(leaves: Any, transforms: Array, x_d: Array) -> Array:
        return broyden_roots(case, case.start, leaves, transforms, x_d, UNROLLED_STEPS["broyden"])

    return {
        "implicit_root": implicit,
        "find_correspondences": plain,
        "unrolled Newton": newton,
        "unrolled Broyden": broyden,
    }


class Anchored(AbstractSkinningField):
    """A field with one extra bone of zero weight, whose inverse transform gives a chosen start."""

    inner: AbstractSkinningField

    def __call__(self, x_c: Array) -> Array:
        return jnp.concatenate([self.inner(x_c), jnp.zeros(1, x_c.dtype)])

    def covers(self, x_c: Array) -> Array:
        return self.inner.covers(x_c)


def directional(
    fn: Callable[[Any, Array, Array], Array], case: Case, varied: str, mode: str
) -> Callable[[], Array]:
    """The derivative along a direction: `(P, 3)` in forward mode, one number in reverse mode.

    Mode `gradient` returns the full gradient of reverse mode as one vector.
    """
    position = VARIED.index(varied)
    args = (case.leaves, case.transforms, case.x_d)

    def of(value: Any, args: tuple) -> Array:
        leaves, transforms, x_d = (*args[:position], value, *args[position + 1 :])
        return fn(leaves, transforms, x_d)

    def forward(args: tuple, direction: Any) -> Array:
        return jax.jvp(lambda v: of(v, args), (args[position],), (direction,))[1]

    def gradient(args: tuple, direction: Any) -> Array:
        del direction
        slope = jax.grad(lambda v: jnp.sum(of(v, args) * case.cotangent))(args[position])
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(slope)])

    def reverse(args: tuple, direction: Any) -> Array:
        along = jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(direction)])
        return jnp.sum(gradient(args, direction) * along)

    run = jax.jit({"forward": forward, "reverse": reverse, "gradient": gradient}[mode])
    return lambda: run(args, case.direction[varied])


def differences(case: Case, root: Array, varied: str) -> Array:
    """Fourth-order central differences of recomputed roots."""

    @jax.jit
    def at(by: Array) -> Array:
        leaves, transforms, x_d = case.moved(varied, by)
        return newton_roots(case, root, leaves, transforms, x_d, 12)

    def slope(step: float) -> Array:
        return (at(jnp.asarray(step)) - at(jnp.asarray(-step))) / (2 * step)

    step = STEP[varied]
    return (4 * slope(step) - slope(2 * step)) / 3


def accuracy_rows(
    field: Any, problems: list, count: int, seed: int, names: tuple[str, ...]
) -> tuple[list, dict[str, Any]]:
    """Errors of every method in float64, and the references for float32."""
    rows, kept = [], {}
    with jax.enable_x64(True):
        case = Case(field, problems, count, seed)
        root = jax.jit(
            lambda: newton_roots(case, case.start, case.leaves, case.transforms, case.x_d, 15)
        )()
        error, det = jax.jit(
            jax.vmap(lambda x, p, b: _quality(case, x, p, b))
        )(root, case.x_d, case.transforms)  # fmt: skip
        regular = np.asarray((error < 1e-12) & (jnp.abs(det) >= MIN_DETERMINANT))
        kept = {"regular": regular, "float64": {}, "determinant": np.asarray(det)}
        for varied in VARIED:
            expected = np.asarray(differences(case, root, varied))
            scale = np.linalg.norm(expected, axis=-1)
            for name in names:
                fn = methods(case, root, 1e-12)[name]
                found = np.asarray(directional(fn, case, varied, "forward")())
                gap = (np.linalg.norm(found - expected, axis=-1) / scale)[regular]
                rows.append(_row(name, varied, "forward", gap, found))
                # Reverse mode gives one number for all points: by linearity, the same sum.
                chosen = jnp.where(jnp.asarray(regular)[:, None], case.cotangent, 0.0)
                case.cotangent, before = chosen, case.cotangent
                total = float(directional(fn, case, varied, "reverse")())
                wanted = float((np.asarray(chosen) * expected).sum())
                size = np.abs(np.asarray(chosen) * expected).sum()
                rows.append(_row(name, varied, "reverse", np.array([abs(total - wanted) / size]),
                                 np.array(total)))  # fmt: skip
                case.cotangent = before
            implicit = methods(case, root, 1e-12)["implicit_root"]
            case.cotangent = jnp.where(jnp.asarray(regular)[:, None], case.cotangent, 0.0)
            for mode in ("forward", "gradient"):
                kept["float64"][varied, mode] = np.asarray(
                    directional(implicit, case, varied, mode)()
                )
        kept["root"] = np.asarray(root)
    return rows, kept


def _quality(case: Case, x: Array, x_d: Array, transforms: Array) -> tuple[Array, Array]:
    posed, jacobian, _ = skin_with_jacobian(case.field(case.leaves), x, transforms)
    return jnp.linalg.norm(posed - x_d), determinant_3x3(jacobian)


def _row(method: str, varied: str, mode: str, gap: np.ndarray, found: np.ndarray) -> dict[str, Any]:
    return {
        "table": "accuracy",
        "method": method,
        "by": varied,
        "mode": mode,
        "points": len(gap),
        "relative_error_max": float(gap.max()),
        "relative_error_median": float(np.median(gap)),
        "share_below_1e-5": float((gap < 1e-5).mean()),
        "finite": bool(np.isfinite(found).all()),
    }


def float32_rows(field: Any, problems: list, count: int, seed: int, kept: dict) -> list:
    """Implicit derivatives in float32, at roots of the float32 search, relative to float64."""
    case, rows = Case(field, problems, count, seed), []
    regular = jnp.asarray(kept["regular"])[:, None]
    case.cotangent = jnp.where(regular, case.cotangent, 0.0)
    near = jnp.asarray(kept["root"], jnp.float32)
    # Roots with the residual of a search: about 1e-5 m in posed space.
    rng = np.random.default_rng([seed, 5])
    away = rng.standard_normal(near.shape)
    away = 1e-5 * away / np.linalg.norm(away, axis=-1, keepdims=True)
    left = newton_roots(case, near, case.leaves, case.transforms, case.x_d + away, 3)
    polished = newton_roots(case, left, case.leaves, case.transforms, case.x_d, 1)
    roots = {"root of the search (1e-5 m)": left, "root after one Newton step": polished}
    for place, root in roots.items():
        for varied in VARIED:
            fn = methods(case, root, 1e-6)["implicit_root"]
            for mode in ("forward", "gradient"):
                found = np.asarray(directional(fn, case, varied, mode)())
                expected = kept["float64"][varied, mode]
                # In reverse mode, one vector for all points, as in a training step.
                chosen = kept["regular"] if mode == "forward" else None
                found, expected = found[chosen], expected[chosen]
                gap = np.linalg.norm(found - expected, axis=-1) / np.linalg.norm(expected, axis=-1)
                rows.append(
                    {
                        "table": "float32",
                        "at": place,
                        "by": varied,
                        "mode": mode,
                        "points": len(gap),
                        "relative_gap_max": float(gap.max()),
                        "relative_gap_p99": float(np.quantile(gap, 0.99)),
                        "relative_gap_median": float(np.median(gap)),
                        "share_below_1e-3": float((gap < 1e-3).mean()),
                    }
                )
    return rows


def time_rows(field: Any, problems: list, count: int, seed: int, repeats: int) -> list:
    """Time of roots and derivatives together, float32."""
    case, rows = Case(field, problems, count, seed), []
    points = len(case.x_d)
    root = newton_roots(case, case.start, case.leaves, case.transforms, case.x_d, 6)
    for name, fn in methods(case, root, 1e-5).items():
        for mode in ("forward", "reverse"):
            run = directional(fn, case, "field", mode)
            clock = time.perf_counter()
            jax.block_until_ready(run())
            first = time.perf_counter() - clock
            _, seconds = least_time(run, repeats)
            rows.append(
                {
                    "table": "time",
                    "method": name,
                    "mode": mode,
                    "points": points,
                    "ms_per_1000_points": 1e6 * seconds / points,
                    "first_call_s": first,
                }
            )
    return rows


def step_row(body: Any, field: Any, problems: list) -> dict[str, Any]:
    """Compile time and number of traces of a training step with the search inside."""
    table = start_table(body)
    traces = []

    @eqx.filter_jit
    def step(field: Any, p: Any) -> tuple[Array, Any]:
        traces.append(1)

        @eqx.filter_value_and_grad
        def loss(field: Any) -> Array:
            roots = search_field(
                jax.lax.stop_gradient(field), p.x_d, p.parts, p.transforms, table, keep=3
            )
            one = lambda x, q: implicit_root(x, q, field, p.transforms)[0]  # noqa: E731
            x_c = jax.vmap(jax.vmap(one, (0, None)))(roots.x_c, p.x_d)
            return jnp.sum(jnp.where(roots.valid[..., None], x_c, 0.0) ** 2)

        return loss(field)

    clock = time.perf_counter()
    jax.block_until_ready(step(field, problems[0]))
    first = time.perf_counter() - clock
    _, second = least_time(lambda: step(field, problems[1]), 1)
    return {
        "table": "step",
        "points": len(problems[0].x_d),
        "first_call_s": first,
        "second_call_s": second,
        "compile_s": first - second,
        "traces": len(traces),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Derivatives of roots: error and time.")
    parser.add_argument("--quick", action="store_true", help="small run of a minute or two")
    parser.add_argument("--json", help="JSON file for header and rows")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--prefit-steps", type=int, help="number of steps to fit the network")
    parser.add_argument("--cache-dir")
    args = parser.parse_args()
    steps = args.prefit_steps or (QUICK_PREFIT if args.quick else FULL_PREFIT)
    body = xa.synthetic_body(args.cache_dir)
    field = paper_field(body, steps, cache=args.cache_dir)
    frames, count = (2, 60) if args.quick else (4, 600)
    problems = hard_problems(
        body, field, grid_vertices(body),
        degrees=20.0, frames=frames, count=600, seed=args.seed,
    )  # fmt: skip
    names = ("implicit_root", "find_correspondences", "unrolled Newton", "unrolled Broyden")
    names = names[:2] if args.quick else names
    rows, kept = accuracy_rows(field, problems, count, args.seed, names)
    rows += float32_rows(field, problems, count, args.seed, kept)
    rows += time_rows(field, problems, 4 * count, args.seed, 1 if args.quick else 3)
    rows.append(step_row(body, field, problems))
    header = {
        "question": "derivatives of roots: implicit, unrolled, finite differences",
        **describe_machine(),
        "quick": args.quick,
        "seed": args.seed,
        "prefit_steps": steps,
        "pose_deg": 20.0,
        "frames": frames,
        "points": len(kept["regular"]),
        "regular_points": int(kept["regular"].sum()),
        "min_determinant": MIN_DETERMINANT,
        "unrolled_steps": UNROLLED_STEPS,
    }
    for name in ("accuracy", "float32", "time", "step"):
        part = [row for row in rows if row["table"] == name]
        print_rows(part, tuple(part[0])[1:])
    write_result(args.json, header, rows)


if __name__ == "__main__":
    main()
