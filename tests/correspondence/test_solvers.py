"""Broyden's method and Newton's, through `optimistix`, on problems with known roots."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.test_util import check_grads

from xavatar_jax.correspondence import Broyden, ClosedFormNewton

A = np.array([[3.0, 1.0, 0.0], [-1.0, 2.0, 0.5], [0.2, 0.0, 4.0]])
B = np.array([1.0, -2.0, 0.5])


def linear(y, args):
    return jnp.asarray(A) @ y - args


def curved(y, args):
    """Roots at (+-sqrt(2) c, +-sqrt(2) c): a circle of radius 2 c and a line."""
    return jnp.array([y[0] ** 2 + y[1] ** 2 - 4 * args**2, y[0] - y[1]])


def valley(y, args):
    """The stationary conditions of Rosenbrock's valley; one root, at (1, 1)."""
    return jnp.array([10 * (y[1] - y[0] ** 2), args - y[0]])


def tree(y, args):
    """A pytree of two leaves."""
    a, b = y["a"], y["b"]
    return {"a": a**3 - args, "b": jnp.stack([b[0] + b[1] - a, b[0] - b[1]])}


PROBLEMS = {
    "linear": (linear, jnp.zeros(3), B, np.linalg.solve(A, B)),
    "curved": (curved, np.array([1.0, 2.0]), 1.0, np.sqrt([2.0, 2.0])),
    "valley": (valley, np.array([0.5, 0.9]), 1.0, np.ones(2)),
    "tree": (tree, {"a": 1.5, "b": np.zeros(2)}, 8.0, {"a": 2.0, "b": np.ones(2)}),
}


def solve(name, **kwargs):
    fn, start, args, _ = PROBLEMS[name]
    start = jax.tree.map(lambda x: jnp.asarray(x, float), start)
    return optx.root_find(fn, Broyden(atol=1e-10), start, jnp.asarray(args), **kwargs)


@pytest.mark.parametrize("name", PROBLEMS)
def test_roots(x64, name):
    run = jax.jit(lambda: solve(name).value)
    for found, expected in zip(
        jax.tree.leaves(run()), jax.tree.leaves(PROBLEMS[name][3]), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_linear_system_takes_one_step_from_the_exact_jacobian(x64):
    assert int(solve("linear").stats["num_steps"]) <= 2


def test_a_wrong_first_estimate_is_mended(x64):
    options = {"inverse_jacobian": jnp.diag(jnp.array([0.3, 0.4, 0.2]))}
    found = solve("linear", options=options)
    np.testing.assert_allclose(found.value, PROBLEMS["linear"][3], atol=1e-9)
    assert int(found.stats["num_steps"]) > 2


@pytest.mark.parametrize("size", [1e-1, 1e-3, 1e-6])
def test_the_update_meets_the_secant_condition(x64, rng, size):
    """The new estimate maps the last change of the residual to the last step, at any scale."""
    target = size * jnp.asarray(rng.normal(size=3))
    start = jnp.asarray(rng.normal(size=3)) * size

    def skew(y, args):
        return jnp.asarray(A) @ y + y**2 / size - args

    solver, no_tags = Broyden(), frozenset()
    options = {"inverse_jacobian": jnp.diag(jnp.array([0.3, 0.4, 0.2]))}
    call = lambda y, args: (skew(y, args), None)  # noqa: E731
    state = solver.init(call, start, target, options, None, None, no_tags)
    for _ in range(4):
        y, after, _ = solver.step(call, start, target, {}, state, no_tags)
        mapped = after.inverse_jacobian @ (after.residual - state.residual)
        np.testing.assert_allclose(mapped, y - start, atol=1e-12 * size)
        start, state = y, after


def test_an_update_without_information_stays_finite():
    """A step after which the residual is the same gives no secant, and no NaN."""
    flat = lambda y, args: (jnp.ones(3), None)  # noqa: E731
    solver, no_tags = Broyden(), frozenset()
    state = solver.init(
        flat, jnp.zeros(3), None, {"inverse_jacobian": jnp.eye(3)}, None, None, no_tags
    )
    _, after, _ = solver.step(flat, jnp.zeros(3), None, {}, state, no_tags)
    assert np.isfinite(after.inverse_jacobian).all()


def test_vmap(x64):
    scales = jnp.array([0.5, 1.0, 2.0])
    start = jnp.array([1.0, 2.0])
    run = jax.vmap(lambda s: optx.root_find(curved, Broyden(atol=1e-10), start * s, s).value)
    expected = np.sqrt(2) * np.outer(scales, [1, 1])
    np.testing.assert_allclose(jax.jit(run)(scales), expected, atol=1e-9)


def test_implicit_gradient_agrees_with_the_analytic_one(x64):
    """A root of A y = b is A^-1 b; that of the circle grows with its scale by sqrt(2)."""

    def root(b):
        return optx.root_find(linear, Broyden(atol=1e-12), jnp.zeros(3), b).value

    np.testing.assert_allclose(jax.jacrev(root)(jnp.asarray(B)), np.linalg.inv(A), atol=1e-10)
    np.testing.assert_allclose(jax.jacfwd(root)(jnp.asarray(B)), np.linalg.inv(A), atol=1e-10)

    def scaled(c):
        return optx.root_find(curved, Broyden(atol=1e-12), jnp.array([1.0, 2.0]), c).value

    slope = jax.jit(jax.jacrev(scaled))(jnp.array(1.3))
    np.testing.assert_allclose(slope, np.sqrt([2.0, 2.0]), atol=1e-9)
    check_grads(jax.jit(scaled), (jnp.array(1.3),), order=1, modes=("fwd", "rev"))


def no_root(y, args):
    return y**2 + args


def away(y, args):
    return jnp.exp(y) + args  # a root nowhere; steps run to minus infinity slowly


@pytest.mark.parametrize(
    ("fn", "start", "solver", "max_steps", "cause"),
    [
        (no_root, 3.0, Broyden(atol=1e-6, divergence=5.0), 50, optx.RESULTS.nonlinear_divergence),
        (away, 1.0, Broyden(atol=1e-9), 7, optx.RESULTS.nonlinear_max_steps_reached),
        (linear, jnp.nan, Broyden(atol=1e-9), 50, optx.RESULTS.nonfinite),
        (lambda y, a: jnp.log(y) + 3, 1.0, Broyden(atol=1e-9), 50, optx.RESULTS.nonfinite),
    ],
    ids=["divergence", "max_steps", "nan_start", "leaves_the_domain"],
)
def test_failures_are_values_with_a_cause(x64, fn, start, solver, max_steps, cause):
    y = jnp.full(3 if fn is linear else 1, start)
    args = jnp.asarray(B) if fn is linear else jnp.array(0.05)
    found = optx.root_find(fn, solver, y, args, max_steps=max_steps, throw=False)
    assert found.result == cause
    with pytest.raises(Exception, match=r"(?s)."):
        jax.block_until_ready(optx.root_find(fn, solver, y, args, max_steps=max_steps).value)


@pytest.mark.parametrize("steps", [3, 40])
def test_the_residual_belongs_to_the_iterate_returned(x64, steps):
    """x^2 + 0.05 has no root: the last iterate must not come with the best residual."""
    solver = Broyden(atol=1e-8)

    @jax.jit
    def run(start):
        found = optx.root_find(
            no_root, solver, start, jnp.array(0.05), max_steps=steps, throw=False
        )
        good = found.result == optx.RESULTS.successful
        return found.value[0], found.stats["residual_norm"], good

    for start in (0.3, 0.9, 2.0):
        value, residual, good = run(jnp.array([start]))
        assert not bool(good)
        np.testing.assert_allclose(residual, float(value) ** 2 + 0.05, rtol=1e-12)


def test_wrong_uses_are_refused():
    with pytest.raises(ValueError, match=r"as many equations as unknowns: 2 .* 3"):
        optx.root_find(lambda y, a: y[:2], Broyden(), jnp.ones(3))
    with pytest.raises(ValueError, match=r"inverse_jacobian.*\(2, 2\), expected \(3, 3\)"):
        optx.root_find(
            lambda y, a: y, Broyden(), jnp.ones(3), options={"inverse_jacobian": jnp.eye(2)}
        )


def cubic(y, args):
    """Residual and exact Jacobian; the root is (1, 2, 3) at zero args."""
    value = jnp.array([y[0] ** 3 - 1, y[1] * y[0] - 2, y[2] + y[1] - 5]) - args
    jacobian = jnp.array([[3 * y[0] ** 2, 0, 0], [y[1], y[0], 0], [0, 1.0, 1.0]])
    return value, jacobian


def test_newton_with_its_own_jacobian(x64):
    def run(args):
        return optx.root_find(
            cubic, ClosedFormNewton(atol=1e-11), jnp.array([1.2, 1.8, 2.9]), args, has_aux=True
        ).value

    np.testing.assert_allclose(jax.jit(run)(jnp.zeros(3)), [1, 2, 3], atol=1e-10)
    many = jax.jit(jax.vmap(run))(0.1 * jnp.eye(3))
    for found, shift in zip(many, 0.1 * np.eye(3), strict=True):
        np.testing.assert_allclose(cubic(found, shift)[0], 0, atol=1e-10)
    slope = jax.jit(jax.jacrev(run))(jnp.zeros(3))
    np.testing.assert_allclose(slope, np.linalg.inv(cubic(np.array([1.0, 2, 3]), 0)[1]), atol=1e-9)


def test_newton_steps_are_cut():
    """From far away a step is no longer than `max_step`."""
    solver = ClosedFormNewton(atol=1e-9, max_step=0.1)
    fn = lambda y, a: (y, jnp.eye(3))  # noqa: E731
    found = optx.root_find(
        fn, solver, jnp.array([1.0, 0, 0]), has_aux=True, max_steps=4, throw=False
    )
    np.testing.assert_allclose(found.value, [0.6, 0, 0], atol=1e-6)
    done = optx.root_find(fn, solver, jnp.array([1.0, 0, 0]), has_aux=True, max_steps=20)
    np.testing.assert_allclose(done.value, 0, atol=1e-6)


def test_newton_stops_at_a_singular_jacobian():
    fn = lambda y, a: (y + 1, jnp.zeros((3, 3)))  # noqa: E731
    found = optx.root_find(
        fn, ClosedFormNewton(), jnp.ones(3), has_aux=True, max_steps=20, throw=False
    )
    assert found.result == optx.RESULTS.nonfinite
