"""The search on a two-bone arm whose field is known: roots, failures and gradients."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import (
    TOLERANCE,
    ArmField,
    all_finite,
    arm_skin,
    arm_transforms,
    central_difference,
    refused,
    two_bone_arm,
)

from xavatar_jax.correspondence import (
    MIN_DETERMINANT,
    Broyden,
    ClosedFormNewton,
    Outcome,
    StartTable,
    find_correspondences,
    implicit_root,
    move_roots,
    pull_back,
    search_field,
    search_grid,
)
from xavatar_jax.fields import (
    AbstractSkinningField,
    GridSpacing,
    build_part_grids,
    pose_grid,
    skin_with_jacobian,
    tabulate,
)

BENDS = {"rest": 0.0, "elbow": 0.6, "sharp": 1.2}
FOLD = 2.8  # radians: the forearm lies along the upper arm
SHARP = 20.0


@eqx.filter_jit
def find(points, field, transforms, **kwargs):
    search = lambda x: find_correspondences(  # noqa: E731
        x, field, transforms, init_bones=(0, 1), **kwargs
    )
    return jax.vmap(search)(points)


@pytest.mark.parametrize("bend", BENDS.values(), ids=BENDS)
def test_the_search_inverts_skinning(rng, bend):
    field, transforms = two_bone_arm(bend)
    x_c = rng.uniform(-0.3, 0.3, (64, 3)) * [1, 0.3, 0.3]
    out = find(jnp.asarray(arm_skin(x_c, bend), jnp.float32), field, transforms)
    assert out.x_c.shape == (64, 2, 3)
    assert bool(jnp.all(jnp.any(out.found, -1)))
    again = np.stack([arm_skin(np.asarray(out.x_c[:, k]), bend) for k in range(2)], 1)
    residual = np.linalg.norm(again - arm_skin(x_c, bend)[:, None], axis=-1)
    # A residual must belong to the point returned, found or not.
    np.testing.assert_allclose(out.residual, residual, atol=1e-6)
    assert (residual[np.asarray(out.found)] < TOLERANCE["search_m"] + 1e-6).all()
    assert bool(jnp.all(out.found == (out.result == optx.RESULTS.successful)))
    nearest = np.linalg.norm(np.asarray(out.x_c) - x_c[:, None], axis=-1)
    nearest = np.where(np.asarray(out.found), nearest, np.inf).min(1)
    # Where the map folds, another point may be a root as good: the true one is among most.
    assert np.mean(nearest < 1e-3) > 0.9


@pytest.mark.parametrize(
    "solver", [Broyden(atol=1e-9), optx.Newton(rtol=1e-9, atol=1e-9)], ids=["broyden", "newton"]
)
def test_any_solver_of_optimistix(x64, rng, solver):
    field, transforms = two_bone_arm(0.6)
    x_c = rng.uniform(-0.2, 0.2, (8, 3)) * [1, 0.3, 0.3]
    out = find(jnp.asarray(arm_skin(x_c, 0.6)), field, transforms, solver=solver)
    assert bool(jnp.all(jnp.any(out.found, -1)))
    assert float(jnp.where(out.found, out.residual, 0).max()) < 1e-8


def test_broyden_takes_few_steps_to_a_tight_tolerance(x64, rng):
    """5.6 on average to 1e-10 m; an absolute guard of 1e-6 m^2 in the update takes 6.8."""
    field, transforms = two_bone_arm(1.2)
    x_c = rng.uniform(-0.2, 0.2, (200, 3)) * [1, 0.3, 0.3]
    out = find(jnp.asarray(arm_skin(x_c, 1.2)), field, transforms, solver=Broyden(0.0, 1e-10, 1.0))
    found = np.asarray(out.found)
    assert found.mean() > 0.9
    assert np.asarray(out.num_steps)[found].mean() < 6.2


def test_a_plain_function_is_a_field(x64, rng):
    """Also one that closes over the array by which the roots are differentiated."""
    points = jnp.asarray(arm_skin(rng.uniform(-0.2, 0.2, (4, 3)), 0.6))
    transforms = arm_transforms(0.6)

    def total(sharpness, as_function):
        field = ArmField(sharpness)
        fn = (lambda x: field(x)) if as_function else field
        return jnp.sum(find(points, fn, transforms).x_c ** 2)

    slope = jax.jit(jax.value_and_grad(total), static_argnums=1)
    found, expected = (slope(jnp.array(20.0), k) for k in (True, False))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def folded_points():
    """On the upper arm, where the folded forearm lies too."""
    x = np.linspace(-0.35, -0.2, 7)
    return np.stack([x, 0.02 * np.ones(7), 0.01 * np.ones(7)], 1)


def test_a_folded_arm_has_two_roots():
    field, transforms = two_bone_arm(FOLD)
    points = folded_points()
    out = find(jnp.asarray(points, jnp.float32), field, transforms)
    assert bool(out.found.all())
    # 0.2 m from the elbow the other bone has 2 % of the weight: a root is near its own pull-back.
    np.testing.assert_allclose(out.x_c[:, 0], points, atol=1e-2)
    turned = np.asarray(pull_back(jnp.asarray(points[0], jnp.float32), transforms))[1]
    np.testing.assert_allclose(out.x_c[0, 1], turned, atol=1e-2)
    assert (out.x_c[:, 0, 0] < 0).all()
    assert (out.x_c[:, 1, 0] > 0).all()


def test_pull_back_is_the_inverse_of_each_bone(x64, rng):
    transforms, x = arm_transforms(0.8, (0.1, 0.2, 0.3)), rng.normal(size=3)
    expected = [(np.linalg.inv(t) @ np.append(x, 1))[:3] for t in np.asarray(transforms)]
    np.testing.assert_allclose(pull_back(jnp.asarray(x), transforms), expected, atol=1e-12)


def root_by(sharpness, bend, x_d, bone=0):
    """The root as a function of field, pose and point, to a tight tolerance."""
    field, transforms = two_bone_arm(bend, sharpness)
    out = find_correspondences(
        x_d, field, transforms, init_bones=(bone,), solver=Broyden(atol=1e-12, divergence=1.0)
    )
    return out.x_c[0]


def test_implicit_gradients_agree_with_differences(x64):
    """Of the field's parameter, of the transforms and of the point, in both modes."""
    args = (np.array(20.0), np.array(0.6), np.array([0.03, 0.02, -0.04]))
    run = jax.jit(root_by)
    forward = jax.jit(jax.jacfwd(root_by, argnums=(0, 1, 2)))(*args)
    reverse = jax.jit(jax.jacrev(root_by, argnums=(0, 1, 2)))(*args)
    for k in range(3):
        fn = lambda v, k=k: run(*args[:k], v, *args[k + 1 :])  # noqa: E731
        expected = central_difference(fn, args[k], step=1e-5)
        assert np.abs(expected).max() > 1e-6
        np.testing.assert_allclose(forward[k], expected, atol=1e-7)
        np.testing.assert_allclose(reverse[k], expected, atol=1e-7)


def test_gradient_in_every_entry_of_the_transforms(x64):
    field, transforms = two_bone_arm(0.6)
    x_d = jnp.array([0.03, 0.02, -0.04])

    def root(transforms):
        return find_correspondences(
            x_d, field, transforms, init_bones=(1,), solver=Broyden(atol=1e-13, divergence=1.0)
        ).x_c[0]

    found = np.array(jax.jit(jax.jacrev(root))(transforms))
    expected = central_difference(jax.jit(root), np.asarray(transforms), step=1e-6)
    np.testing.assert_allclose(found[..., :3, :], expected[..., :3, :], atol=1e-6)


def test_a_polished_root_has_the_same_gradients(x64):
    def polished(sharpness, bend, x_d):
        field, transforms = two_bone_arm(bend, sharpness)
        root = jax.lax.stop_gradient(root_by(sharpness, bend, x_d))
        return implicit_root(root, x_d, field, transforms)[0]

    args = (np.array(20.0), np.array(0.6), np.array([0.03, 0.02, -0.04]))
    run = jax.jit(root_by)
    np.testing.assert_allclose(jax.jit(polished)(*args), run(*args), atol=1e-12)
    for mode in (jax.jacfwd, jax.jacrev):
        found = jax.jit(mode(polished, argnums=(0, 1, 2)))(*args)
        for k in range(3):
            fn = lambda v, k=k: run(*args[:k], v, *args[k + 1 :])  # noqa: E731
            np.testing.assert_allclose(
                found[k], central_difference(fn, args[k], step=1e-5), atol=1e-7
            )


def test_a_polished_root_is_two_newton_steps_closer(x64):
    field, transforms = two_bone_arm(0.6)
    truth = np.array([[0.05, 0.02, -0.03]])
    x_d = jnp.asarray(arm_skin(truth, 0.6)[0])
    start = jnp.asarray(truth[0] + 1e-4)
    posed, jacobian, _ = skin_with_jacobian(field, start, transforms)
    nearer = start - np.linalg.solve(jacobian, posed - x_d)
    assert np.linalg.norm(nearer - truth[0]) < 2e-6  # quadratic: 1e-4 squared times a curvature
    point, weights, regular = implicit_root(start, x_d, field, transforms)
    assert bool(regular)
    assert np.linalg.norm(point - truth[0]) < 1e-9
    # Derivatives, and weights, are those after the first step.
    np.testing.assert_allclose(weights, field(nearer), atol=1e-12)


def test_where_the_map_folds_there_is_no_derivative(x64):
    """A half turn's blend is singular at the elbow: the point comes back, gradients are zero."""
    field, transforms = two_bone_arm(np.pi)
    x = jnp.zeros(3)
    posed_jacobian = 0.5 * (np.eye(3) + np.asarray(transforms[1, :3, :3]))
    assert abs(np.linalg.det(posed_jacobian)) < MIN_DETERMINANT

    def loss(x_d, field, transforms):
        point, _, regular = implicit_root(x, x_d, field, transforms)
        return jnp.sum(point**2 + point), (point, regular)

    grad = eqx.filter_grad(lambda args: loss(*args), has_aux=True)
    slopes, (point, regular) = grad((jnp.array([0.01, 0.0, 0.0]), field, transforms))
    assert not bool(regular)
    np.testing.assert_array_equal(point, x)
    assert all(not np.asarray(leaf).any() for leaf in jax.tree.leaves(slopes))


def test_the_plain_search_cuts_derivatives_where_the_polished_root_does(x64):
    """Near a fold: both have derivatives at the same points, with or without an adjoint given."""
    bend = 2.9
    field, transforms = two_bone_arm(bend)
    x = np.stack([np.linspace(-0.02, 0.02, 21), np.zeros(21), np.zeros(21)], 1)
    points = jnp.asarray(arm_skin(x, bend))

    def plain(x_d, adjoint):
        search = lambda p: find_correspondences(  # noqa: E731
            p, field, transforms, init_bones=(0,), adjoint=adjoint,
            solver=Broyden(0.0, 1e-12, 1.0),
        )  # fmt: skip
        out = jax.vmap(search)(x_d)
        return jnp.sum(jnp.where(out.found[:, 0, None], out.x_c[:, 0], 0.0)), out

    slopes = {}
    for name, adjoint in {"default": None, "implicit": optx.ImplicitAdjoint()}.items():
        slope, out = jax.jit(jax.grad(lambda p, a=adjoint: plain(p, a), has_aux=True))(points)
        slopes[name] = np.asarray(slope)
    np.testing.assert_array_equal(slopes["default"], slopes["implicit"])
    roots, found = np.asarray(out.x_c[:, 0]), np.asarray(out.found[:, 0])
    det = np.asarray([np.linalg.det(skin_with_jacobian(field, r, transforms)[1]) for r in roots])
    regular = np.abs(det) >= MIN_DETERMINANT
    assert (found & regular).any()
    assert (found & ~regular & (np.abs(det) > 1e-6)).any()
    assert not slopes["default"][found & ~regular].any()
    assert slopes["default"][found & regular].any(axis=1).all()
    _, _, polished = jax.vmap(lambda r, p: implicit_root(r, p, field, transforms))(roots, points)
    assert (np.asarray(polished) == regular)[found].mean() > 0.9


def test_one_bad_point_spoils_no_gradient(x64):
    """A NaN root or a NaN point among others: field and bones get the gradient of the others."""
    field, transforms = two_bone_arm(0.6)
    x_c = np.array([[0.05, 0.01, 0.0], [0.02, -0.03, 0.01], [0.03, 0.0, 0.02]])
    x, points = jnp.asarray(x_c), jnp.asarray(arm_skin(x_c, 0.6))

    def loss(args, roots, points, good):
        field, transforms = args
        out, weights, _ = jax.vmap(lambda r, p: implicit_root(r, p, field, transforms))(
            roots, points
        )
        total = jnp.sum(out**2, axis=1) + weights[:, 0]
        return jnp.sum(jnp.where(good, total, 0.0))

    run = eqx.filter_jit(eqx.filter_grad(loss))
    good = jnp.array([True, False, True])
    expected = run((field, transforms), x, points, good)
    for roots, targets in ((x.at[1].set(jnp.nan), points), (x, points.at[1].set(jnp.inf))):
        found = run((field, transforms), roots, targets, good)
        assert all_finite(found)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)


def test_failed_starts_have_no_gradient(x64):
    """A point that is not finite and one that no bone reaches, among one that is found."""

    class Wall(AbstractSkinningField):
        sharpness: jax.Array

        def __call__(self, x):  # beyond the wall nothing moves, so that nothing arrives
            second = jax.nn.sigmoid(self.sharpness * x[0])
            return jnp.stack([1 - second, second])

        def covers(self, x):
            return x[0] < 0.5

    points = jnp.array([[0.05, 0.01, 0.0], [jnp.nan, 0.0, 0.0], [0.02, -0.03, 0.01]])
    transforms = arm_transforms(0.6)

    def loss(points, field, transforms, rows):
        out = jax.vmap(
            lambda x: find_correspondences(
                x, field, transforms, init_bones=(0, 1), solver=Broyden(atol=1e-11, divergence=1.0)
            )
        )(points[rows])
        return jnp.sum(jnp.where(out.found[..., None], out.x_c, 0.0) ** 2), out

    run = eqx.filter_jit(eqx.filter_grad(lambda a, rows: loss(*a, rows), has_aux=True))
    args = (points, Wall(jnp.array(20.0)), transforms)
    slopes, out = run(args, jnp.array([0, 1, 2]))
    assert bool(out.found[jnp.array([0, 2])].all())
    assert not bool(out.found[1].any())
    assert all_finite(slopes)
    assert not np.asarray(slopes[0][1]).any()
    without, _ = run(args, jnp.array([0, 2]))
    for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(without), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_the_cause_of_each_failure_is_reported():
    field, transforms = two_bone_arm(0.6)
    points = jnp.array([[0.1, 0.02, 0.0], [jnp.nan, 0.0, 0.0], [0.1, jnp.inf, 0.0]])
    out = find(points, field, transforms)
    assert bool(out.found[0].all())
    assert not bool(out.found[1:].any())
    broken = jax.tree.map(lambda leaf: leaf[1:], out.result)
    assert bool(jnp.all(broken == optx.RESULTS.nonfinite))
    few = find(points[:1] * jnp.array([0.1, 1, 1]), field, transforms, max_steps=1)
    assert not bool(few.found.any())
    assert bool(jnp.all(few.result == optx.RESULTS.nonlinear_max_steps_reached))
    with pytest.raises(Exception, match=r"(?s)."):
        jax.block_until_ready(find(points[1:2], field, transforms, throw=True).x_c)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"init_bones": ()}, "at least one bone"),
        ({"init_bones": (0, 2)}, "bone 2 is out of range for 2 joints"),
        ({"init_bones": (-1,)}, "bone -1 is out of range"),
        ({"x_d": jnp.zeros((2, 3))}, r"x_d has shape \(2, 3\).*vmap"),
        ({"transforms": jnp.zeros((2, 3, 4))}, r"transforms have shape \(2, 3, 4\)"),
    ],
)
def test_wrong_arguments(arguments, message):
    field, transforms = two_bone_arm(0.3)
    given = {"x_d": jnp.zeros(3), "transforms": transforms, "init_bones": (0, 1), **arguments}
    with refused(message):
        find_correspondences(given.pop("x_d"), field, **given)


def test_no_retrace_on_the_second_call(rng):
    traces = []

    class Counted(ArmField):
        def __call__(self, x):
            traces.append(1)
            second = jax.nn.sigmoid(self.sharpness * x[0])
            return jnp.stack([1 - second, second])

    def points(k):
        return jnp.asarray(rng.uniform(-0.2, 0.2, (5, 3)) + 0 * k, jnp.float32)

    find(points(0), Counted(jnp.array(20.0)), arm_transforms(0.1))
    first = len(traces)
    assert first > 0
    find(points(1), Counted(jnp.array(15.0)), arm_transforms(0.7))
    assert len(traces) == first


# The fast paths, against the plain search on the same field.


def starts(*rows):
    """A table of the arm's bones, a row for each part."""
    width = max(len(row) for row in rows)
    index = np.array([[*row, *[0] * (width - len(row))] for row in rows], np.int32)
    mask = np.array([[k < len(row) for k in range(width)] for row in rows])
    return StartTable(jnp.asarray(index), jnp.asarray(mask), jnp.array([0, 0]))


STARTS = starts((0, 1), (1,))


def cloud(rng, bend, count=150):
    """Posed points of the arm, and some anywhere."""
    x_c = rng.uniform([-0.4, -0.05, -0.05], [0.4, 0.05, 0.05], (count, 3))
    stray = rng.uniform(-0.4, 0.4, (count // 4, 3))
    return jnp.asarray(np.concatenate([arm_skin(x_c, bend), stray]), jnp.float32)


def distinct(points, found, apart=5e-4):
    kept = []
    for point in np.asarray(points)[np.asarray(found)]:
        if all(np.linalg.norm(point - other) >= apart for other in kept):
            kept.append(point)
    return np.asarray(kept).reshape(-1, 3)


def assert_same_roots(plain, fast, tolerance, least):
    """Every distinct root of one is in the other, at nearly all points."""
    same = []
    for p in range(len(fast.valid)):
        a = distinct(plain.x_c[p], plain.found[p])
        b = np.asarray(fast.x_c[p])[np.asarray(fast.valid[p])]
        gaps = np.linalg.norm(a[:, None] - b[None], axis=-1)
        same.append(
            len(a) == len(b) and (len(a) == 0 or (gaps.min(0).max() < tolerance
                                                   and gaps.min(1).max() < tolerance))
        )  # fmt: skip
    assert np.mean(same) >= least


@pytest.mark.parametrize("bend", [0.0, 1.2, FOLD], ids=["rest", "sharp", "folded"])
def test_the_fast_search_finds_the_roots_of_the_plain_one(rng, bend):
    field, transforms = two_bone_arm(bend)
    points = cloud(rng, bend)
    fast = search_field(field, points, jnp.zeros(len(points), int), transforms, STARTS, width=64)
    plain = find(points, field, transforms)
    assert_same_roots(plain, fast, 2e-4, least=0.97)
    assert int(fast.lanes) == 2 * len(points)
    assert not np.asarray(fast.more).any()
    valid = np.asarray(fast.valid)
    assert (np.asarray(fast.residual)[valid] < 1e-5).all()
    assert np.isinf(np.asarray(fast.residual)[~valid]).all()
    roots = np.asarray(fast.x_c)[valid]
    points = np.repeat(np.asarray(points)[:, None], valid.shape[1], 1)[valid]
    residual = np.linalg.norm(arm_skin(roots, bend) - points, axis=1)
    np.testing.assert_allclose(np.asarray(fast.residual)[valid], residual, atol=1e-6)


@pytest.mark.parametrize(
    "solver",
    [
        optx.Newton(rtol=1e-6, atol=1e-5),
        optx.Chord(rtol=1e-6, atol=1e-5),
        ClosedFormNewton(atol=1e-5, divergence=1.0),
    ],
    ids=["newton", "chord", "closed_form"],
)
def test_the_batched_search_takes_any_solver(rng, solver):
    """Solvers of optimistix hold no residual of their last iterate: it is measured."""
    field, transforms = two_bone_arm(0.6)
    points = cloud(rng, 0.6, 60)
    fast = search_field(
        field, points, jnp.zeros(len(points), int), transforms, STARTS, solver=solver, width=32
    )
    assert_same_roots(find(points, field, transforms), fast, 2e-4, least=0.97)
    valid = np.asarray(fast.valid)
    again = np.repeat(np.asarray(points)[:, None], valid.shape[1], 1)[valid]
    residual = np.linalg.norm(arm_skin(np.asarray(fast.x_c)[valid], 0.6) - again, axis=1)
    np.testing.assert_allclose(np.asarray(fast.residual)[valid], residual, atol=1e-6)
    assert residual.max() < 1.1e-5


@pytest.fixture(scope="module")
def arm_table():
    line = np.stack([np.linspace(-0.5, 0.5, 200), np.zeros(200), np.zeros(200)], 1)
    spacing = GridSpacing(body=0.016, band=0.12)
    grids = build_part_grids(line, np.zeros(200, int), spacing, fine_parts={})
    return tabulate(ArmField(jnp.asarray(20.0)), grids)


@pytest.mark.parametrize("bend", [0.0, 1.2, FOLD], ids=["rest", "sharp", "folded"])
def test_the_grid_search_finds_the_roots_of_the_plain_one(rng, arm_table, bend):
    """On the tabulated field both solve the same equations, by Newton and by Broyden."""
    transforms = arm_transforms(bend)
    points = cloud(rng, bend)[:150]
    fast = search_grid(
        pose_grid(arm_table, transforms), points, jnp.zeros(len(points), int), transforms,
        STARTS, width=64,
    )  # fmt: skip
    plain = find(points, arm_table, transforms)
    assert_same_roots(plain, fast, 2e-4, least=0.9)
    assert np.asarray(fast.valid.any(1)).mean() > 0.97


def test_both_roots_of_the_folded_arm_come_out_once(arm_table):
    field, transforms = two_bone_arm(FOLD)
    points = jnp.asarray(folded_points(), jnp.float32)
    parts = jnp.zeros(len(points), int)
    # Every bone twice: duplicates must go, and the two roots stay.
    table = starts((0, 1, 0, 1, 1))
    for found in (
        search_field(field, points, parts, transforms, table),
        search_grid(pose_grid(arm_table, transforms), points, parts, transforms, table),
    ):
        np.testing.assert_array_equal(np.asarray(found.valid).sum(1), 2)
        assert (np.asarray(found.x_c)[:, 0, 0] < 0).all()
        assert (np.asarray(found.x_c)[:, 1, 0] > 0).all()
    one = search_field(field, points, parts, transforms, table, keep=1)
    np.testing.assert_array_equal(one.valid.sum(1), 1)
    assert bool(one.more.all())


def test_each_part_starts_from_its_own_bones():
    """Part 1 starts from the second bone alone, and finds its root alone."""
    field, transforms = two_bone_arm(FOLD)
    points = jnp.asarray(folded_points(), jnp.float32)
    found = search_field(field, points, jnp.ones(len(points), int), transforms, STARTS)
    np.testing.assert_array_equal(np.asarray(found.valid).sum(1), 1)
    assert (np.asarray(found.x_c)[:, 0, 0] > 0).all()
    assert int(found.lanes) == len(points)


def test_a_point_that_is_not_finite_has_no_roots_and_harms_no_other(rng, arm_table):
    field, transforms = two_bone_arm(1.2)
    points = cloud(rng, 1.2, 40)
    parts = jnp.zeros(len(points), int)
    broken = points.at[7].set(jnp.array([0.0, jnp.nan, 0.0])).at[20].set(jnp.inf)
    rest = np.setdiff1d(np.arange(len(points)), [7, 20])
    for run in (
        lambda p: search_field(field, p, parts, transforms, STARTS, width=16),
        lambda p: search_grid(
            pose_grid(arm_table, transforms), p, parts, transforms, STARTS, width=16
        ),
    ):
        good, bad = run(points), run(broken)
        assert not np.asarray(bad.valid)[[7, 20]].any()
        np.testing.assert_array_equal(np.asarray(bad.valid)[rest], np.asarray(good.valid)[rest])
        keep = np.asarray(good.valid)[rest]
        np.testing.assert_allclose(
            np.asarray(bad.x_c)[rest][keep], np.asarray(good.x_c)[rest][keep], atol=1e-6
        )


@pytest.mark.parametrize("width", [1, 7])
def test_the_number_of_lanes_stepped_together_changes_nothing(rng, width):
    field, transforms = two_bone_arm(1.2)
    points = cloud(rng, 1.2, 24)
    parts = jnp.zeros(len(points), int)
    # Only lanes of one block can be merged.
    found = search_field(field, points, parts, transforms, STARTS, width=width, merge=0.0)
    expected = search_field(field, points, parts, transforms, STARTS, merge=0.0)
    np.testing.assert_array_equal(found.valid, expected.valid)
    np.testing.assert_allclose(
        np.where(found.valid[..., None], found.x_c, 0),
        np.where(expected.valid[..., None], expected.x_c, 0),
        atol=1e-6,
    )
    assert int(found.steps) == int(expected.steps)


def test_chunks_of_points_change_nothing(rng, arm_table):
    points = cloud(rng, 1.2, 40)
    parts = jnp.asarray(np.arange(len(points)) % 2)
    grid = pose_grid(arm_table, arm_transforms(1.2))
    whole = search_grid(grid, points, parts, arm_transforms(1.2), STARTS)
    for chunk in (1, 16, len(points) - 1):
        cut = search_grid(grid, points, parts, arm_transforms(1.2), STARTS, chunk=chunk)
        np.testing.assert_array_equal(cut.valid, whole.valid)
        keep = np.asarray(whole.valid)
        np.testing.assert_allclose(
            np.asarray(cut.x_c)[keep], np.asarray(whole.x_c)[keep], atol=1e-6
        )
        assert bool(jnp.all(cut.outcome == whole.outcome))
        assert int(cut.lanes) == int(whole.lanes)


@pytest.mark.parametrize("bend", [0.0, 0.6, 1.2], ids=["rest", "bent", "sharp"])
def test_a_guided_search_gives_the_fields_own_roots(rng, arm_table, bend):
    """Found on the grid, moved to the field: as the plain search on the field itself."""
    field, transforms = two_bone_arm(bend)
    x_c = rng.uniform([-0.4, -0.05, -0.05], [0.4, 0.05, 0.05], (150, 3))
    points = jnp.asarray(arm_skin(x_c, bend), jnp.float32)
    parts = jnp.zeros(len(points), int)
    grid = pose_grid(arm_table, transforms)
    fast = search_field(field, points, parts, transforms, STARTS, guide=grid)
    plain = find(points, field, transforms)
    near = eqx.tree_at(lambda p: p.found, plain, plain.found & arm_table.covers(plain.x_c))
    assert_same_roots(near, fast, 2e-4, least=0.97)
    roots = np.asarray(fast.x_c)
    residual = np.linalg.norm(
        arm_skin(roots.reshape(-1, 3), bend).reshape(roots.shape) - np.asarray(points)[:, None],
        axis=-1,
    )
    assert residual[np.asarray(fast.valid)].max() < 1.1e-5
    on_grid = search_grid(grid, points, parts, transforms, STARTS)
    if bend:  # there is something to mend: trilinear weights are not the field's
        moved = np.linalg.norm(np.asarray(on_grid.x_c)[:, 0] - roots[:, 0], axis=-1)
        assert moved[np.asarray(fast.valid)[:, 0]].max() > 1e-5


@pytest.mark.parametrize("guided", [True, False])
def test_moved_roots_are_tested_on_the_field(rng, arm_table, guided):
    """Roots of an earlier field are moved; what is no root any more is reported."""
    transforms = arm_transforms(1.2)
    x_c = rng.uniform([-0.4, -0.03, -0.03], [0.4, 0.03, 0.03], (200, 3))
    points = jnp.asarray(arm_skin(x_c, 1.2), jnp.float32)
    field = ArmField(jnp.asarray(20.0))
    jacobian = jax.vmap(lambda x: skin_with_jacobian(field, x, transforms)[1])(
        jnp.asarray(x_c, jnp.float32)
    )
    clear = np.abs(np.linalg.det(np.asarray(jacobian))) > 0.3
    guide = pose_grid(arm_table, transforms) if guided else None
    stored = jnp.asarray(x_c + 1e-3 * rng.normal(size=x_c.shape), jnp.float32)
    gone = np.arange(200) % 10 == 0
    # Ten centimetres from the root, one step would have to be longer than allowed.
    stored = jnp.where(gone[:, None], stored + jnp.array([0.0, 0.1, 0.0]), stored)
    stored = stored.at[3].set(jnp.nan)
    run = eqx.filter_jit(move_roots)
    moved, valid = run(field, guide, stored, points, transforms, steps=3, atol=1e-4)
    residual = np.linalg.norm(arm_skin(np.asarray(moved), 1.2) - np.asarray(points), axis=1)
    near = np.abs(residual - 1e-4) < 1e-6
    np.testing.assert_array_equal(np.asarray(valid)[~near], (residual < 1e-4)[~near])
    assert not np.asarray(valid)[gone].any()
    assert not bool(valid[3])
    kept = clear & ~gone & (np.arange(200) != 3)
    assert np.asarray(valid)[kept].mean() > 0.95
    away = np.linalg.norm(np.asarray(moved) - x_c, axis=1)[kept & np.asarray(valid)]
    assert np.quantile(away, 0.95) < 5e-4
    assert np.linalg.norm(np.asarray(moved)[gone] - np.asarray(stored)[gone], axis=1).max() < 0.06


def test_moving_roots_asks_the_field_once_a_step_and_once_more(arm_table):
    asked = []

    class Counted(ArmField):
        def __call__(self, x):
            asked.append(1)
            second = jax.nn.sigmoid(self.sharpness * x[0])
            return jnp.stack([1 - second, second])

    grid = pose_grid(arm_table, arm_transforms(0.6))
    x = jnp.full((2, 2, 3), 0.05)
    moved, valid = move_roots(Counted(jnp.asarray(20.0)), grid, x, x, arm_transforms(0.6), steps=2)
    assert len(asked) == 3
    assert moved.shape == (2, 2, 3)
    assert valid.shape == (2, 2)


def test_merging_starts_changes_no_root(rng, arm_table):
    points = cloud(rng, 1.2)
    parts = jnp.zeros(len(points), int)
    transforms = arm_transforms(1.2)
    table = starts((0, 1, 0, 1, 0, 1))
    grid = pose_grid(arm_table, transforms)
    merged = search_grid(grid, points, parts, transforms, table)
    alone = search_grid(grid, points, parts, transforms, table, merge=0.0)
    np.testing.assert_array_equal(merged.valid, alone.valid)
    keep = np.asarray(alone.valid)
    np.testing.assert_allclose(
        np.sort(np.where(keep[..., None], merged.x_c, 0), axis=1),
        np.sort(np.where(keep[..., None], alone.x_c, 0), axis=1),
        atol=1e-4,
    )
    assert int(merged.steps) < 0.95 * int(alone.steps)


def test_the_outcome_says_what_became_of_each_point(arm_table):
    field, transforms = two_bone_arm(0.6)
    points = jnp.array(
        [[0.1, 0.02, 0.0], [0.1, jnp.nan, 0.0], [0.1, 0.02, 0.0], [0.1, 0.02, 0.0], [9.0, 9.0, 9.0]]
    )
    parts = jnp.array([0, 0, 2, -1, 0])
    grid = pose_grid(arm_table, transforms)
    expected = [
        Outcome.found, Outcome.not_finite, Outcome.no_start, Outcome.no_start, Outcome.outside
    ]  # fmt: skip
    for found in (
        search_grid(grid, points, parts, transforms, STARTS),
        search_field(field, points, parts, transforms, STARTS, guide=grid),
    ):
        for k, cause in enumerate(expected):
            assert jax.tree.map(lambda leaf, k=k: leaf[k], found.outcome) == cause, k
        np.testing.assert_array_equal(found.valid.any(1), [True, False, False, False, False])
    few = search_grid(grid, points[:1], parts[:1], transforms, STARTS, max_steps=0)
    assert jax.tree.map(lambda leaf: leaf[0], few.outcome) == Outcome.not_converged

    class Jump(ArmField):
        def __call__(self, x):  # far ends move away from where they are looked for
            return 10.0 * super().__call__(x)

    away = search_field(
        Jump(jnp.asarray(20.0)), points[:1] + 0.5, parts[:1], transforms, STARTS, max_steps=3
    )
    assert jax.tree.map(lambda leaf: leaf[0], away.outcome) == Outcome.diverged


@pytest.mark.parametrize("bad", ["shear", "nan", "zero"])
def test_transforms_that_are_not_rigid_are_reported(arm_table, bad):
    _, transforms = two_bone_arm(0.6)
    broken = {
        "shear": transforms.at[1, 0, 1].add(0.1),
        "nan": transforms.at[1, 0, 3].set(jnp.nan),
        "zero": transforms.at[1, :3, :3].set(0.0),
    }[bad]
    points, parts = jnp.array([[0.1, 0.02, 0.0]]), jnp.zeros(1, int)
    found = search_grid(pose_grid(arm_table, broken), points, parts, broken, STARTS)
    assert not found.valid.any()
    assert jax.tree.map(lambda leaf: leaf[0], found.outcome) == Outcome.bad_transforms
    scaled = transforms.at[:, :3].multiply(1.7)  # one scale is fine
    again = search_grid(pose_grid(arm_table, scaled), 1.7 * points, parts, scaled, STARTS)
    assert again.valid.any()


def test_no_points_have_no_roots(arm_table):
    field, transforms = two_bone_arm(0.6)
    grid = pose_grid(arm_table, transforms)
    empty = jnp.zeros((0, 3)), jnp.zeros(0, int)
    for found in (
        search_grid(grid, *empty, transforms, STARTS),
        search_field(field, *empty, transforms, STARTS),
        search_field(field, *empty, transforms, STARTS, guide=grid),
    ):
        assert found.valid.shape[0] == 0
        assert int(found.lanes) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x_d": jnp.zeros(3)}, r"x_d has shape \(3,\), expected \('any', 3\)"),
        ({"parts": jnp.zeros(3, int)}, r"parts has shape \(3,\), expected \(2,\)"),
        ({"transforms": jnp.zeros((3, 4, 4))}, r"transforms has shape \(3, 4, 4\).*\(2, 4, 4\)"),
    ],
)
def test_wrong_shapes(arm_table, change, message):
    _, transforms = two_bone_arm(0.6)
    given = {"x_d": jnp.zeros((2, 3)), "parts": jnp.zeros(2, int), "transforms": transforms}
    grid = pose_grid(arm_table, transforms)
    with refused(message):
        search_grid(grid, **{**given, **change}, starts=STARTS)
