"""What a stage updates and lowers: against gradients and updates written out in NumPy."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from toy_problem import (
    ADAM,
    SGD,
    DrawRows,
    Points,
    SquaredError,
    WholeData,
    line,
    points,
    same,
    stage,
    two_stages,
)

from xavatar_jax.learning import (
    CONSTANT,
    FALLING,
    STEPWISE,
    Schedule,
    autodiff,
    train,
)

EVERY_STEP = {"report_every": 1}


def train_line(stages, steps, **options):
    return train(line(), points(), stages, Schedule(steps, **EVERY_STEP), verbose=False, **options)


def slope_gradient(model, data):
    x, y = np.asarray(data.x, np.float64), np.asarray(data.y, np.float64)
    off = x @ np.asarray(model.slope, np.float64) + float(model.offset + model.fixed) - y
    return 2 * x.T @ off / len(x)


def test_terms_are_added_with_their_weights():
    def mean(model, batch, key):
        return model.slope.mean()

    def cubes(model, batch, key):
        return (batch.x.sum() * (model.slope - 1) ** 3).sum(), jnp.asarray(4)  # sum and count

    terms = {"error": (1.0, SquaredError()), "mean": (3.0, mean), "cubes": (0.5, cubes)}
    whole = stage(draw=WholeData(), terms=terms, optimiser=SGD)
    done = train_line([whole], 1)
    data = points()
    total = float(data.x.sum())
    gradient = slope_gradient(line(), data) + 3 / 3 + 0.5 * 3 * total / 4
    np.testing.assert_allclose(done.model.slope, -0.1 * gradient, rtol=1e-5)
    heard = {name: values[0] for name, values in done.history.terms.items()}
    error = ((np.asarray(data.y, np.float64) - 0.25) ** 2).mean()
    np.testing.assert_allclose(heard["error"], error, rtol=1e-5)
    np.testing.assert_allclose(heard["cubes"], -3 * total / 4, rtol=1e-4)
    np.testing.assert_allclose(heard["loss"], error + 0.5 * heard["cubes"], rtol=1e-5)
    np.testing.assert_allclose(heard["gradient"], np.linalg.norm(gradient), rtol=1e-5)


def test_each_term_draws_for_itself():
    def draw(model, batch, key):
        return jax.random.uniform(key)

    terms = {"error": (1.0, SquaredError()), "a": (1.0, draw), "b": (1.0, draw)}
    heard = train_line([stage(terms=terms)], 2).history.terms
    assert len({*heard["a"], *heard["b"]}) == 4


def test_a_term_of_weight_zero_is_recorded_and_not_trained_on():
    def steep(model, batch, key):
        return 1e3 * model.slope.sum()

    plain = train_line([stage()], 3)
    more = train_line([stage(terms={"error": (1.0, SquaredError()), "steep": (0.0, steep)})], 3)
    assert "steep" in more.history.terms
    np.testing.assert_array_equal(more.history.terms["loss"], more.history.terms["error"])
    np.testing.assert_allclose(plain.model.slope, more.model.slope, rtol=1e-6)


def test_weights_may_follow_the_run():
    """A weight that is a schedule is a function of the share of the run that is done."""

    def one(model, batch, key):
        return 1.0 + 0 * model.slope.sum()

    rising = optax.linear_schedule(2.0, 10.0, 1)
    heard = train_line([stage(terms={"one": (rising, one)})], 8).history.terms
    np.testing.assert_allclose(heard["loss"], [2 + 8 * k / 8 for k in range(8)], rtol=1e-5)


def test_what_terms_share_is_computed_once_and_differentiated():
    traced = []

    class Residuals(eqx.Module):
        def __call__(self, model, batch, key):
            traced.append(1)
            return model(batch.x) - batch.y

    def error(model, residuals, key):
        return (residuals**2).mean()

    def size(model, residuals, key):
        return jnp.abs(residuals).mean()

    shared = stage(
        draw=WholeData(), optimiser=SGD, forward=Residuals(),
        terms={"error": (1.0, error), "size": (0.0, size)},
    )  # fmt: skip
    done = train_line([shared], 1)
    assert len(traced) == 1
    expected = -0.1 * slope_gradient(line(), points())
    np.testing.assert_allclose(done.model.slope, expected, rtol=1e-5)
    np.testing.assert_allclose(
        done.history.terms["size"][0], np.abs(np.asarray(points().y) - 0.25).mean(), rtol=1e-5
    )


def test_the_draw_is_not_differentiated():
    """Its derivative would be that of the whole error, with respect to the drawn slope too."""

    class Ahead(eqx.Module):
        def __call__(self, model, data, key):
            return Points(data.x, data.y + data.x @ model.slope)

    start = eqx.tree_at(lambda m: m.slope, line(), jnp.ones(3))
    ahead = stage(draw=Ahead(), optimiser=SGD)
    data = points()
    done = train(start, data, [ahead], Schedule(1), verbose=False)
    seen = Points(data.x, data.y + data.x @ jnp.ones(3))
    expected = 1 - 0.1 * slope_gradient(start, seen)
    np.testing.assert_allclose(done.model.slope, expected, rtol=1e-5)


def test_only_the_leaves_of_a_stage_change():
    done = train_line([stage()], 3)
    assert not np.array_equal(done.model.slope, line().slope)
    assert same((done.model.offset, done.model.fixed), (line().offset, line().fixed))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_stages_take_turns_and_the_last_that_is_due_takes_the_step(order):
    """Every second step and every third: the sixth is due in both."""
    pair = (
        stage("a", every=2, prefix="a_"),
        stage("b", ("offset",), every=3, prefix="b_"),
    )
    seen = {}
    stages = [pair[k] for k in order]
    train_line(stages, 7, callback=lambda k, model, terms: seen.update({k: model}))
    before, taken = line(), []
    for k in range(1, 8):
        changed = [
            n for n in ("slope", "offset") if not same(getattr(before, n), getattr(seen[k], n))
        ]
        taken.append({"slope": "a", "offset": "b"}["".join(changed)])
        before = seen[k]
    last, first = "ab"[order[1]], "ab"[order[0]]
    # Steps 0 to 6. Where none is due, the first of the list takes it.
    assert taken == [last, first, "a", "b", "a", first, last]


def test_names_of_terms_have_the_prefix_of_their_stage():
    terms = train_line(two_stages(), 5).history.terms
    assert set(terms) == {p + n for p in ("", "offset_") for n in ("loss", "gradient", "error")}


def rates(schedule, steps):
    """Factors on the updates, from plain gradient steps of a constant gradient."""

    def tilt(model, batch, key):
        return model.slope.sum()

    seen = {0: line()}
    tilted = stage(terms={"tilt": (1.0, tilt)}, optimiser=SGD, schedule=schedule)
    train_line([tilted], steps, callback=lambda k, model, terms: seen.update({k: model}))
    return [float(seen[k].slope[0] - seen[k + 1].slope[0]) / 0.1 for k in range(steps)]


def test_rates_fall_along_a_cosine_to_a_hundredth():
    expected = [0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * k / 8)) for k in range(8)]
    np.testing.assert_allclose(rates(FALLING, 8), expected, rtol=1e-4)
    assert float(FALLING(jnp.asarray(1.0))) == pytest.approx(0.01)


def test_rates_fall_in_two_steps_or_stay():
    done = [0.0, 0.49, 0.5, 0.74, 0.75, 1.0]
    found = [float(STEPWISE(jnp.asarray(d))) for d in done]
    np.testing.assert_allclose(found, [1, 1, 0.1, 0.1, 0.01, 0.01], rtol=1e-6)
    assert rates(CONSTANT, 3) == pytest.approx([1, 1, 1], rel=1e-4)


def inner_sgd(model, data, steps, rate):
    slope = np.asarray(model.slope, np.float64)
    for _ in range(steps):
        moved = eqx.tree_at(lambda m: m.slope, model, slope)
        slope = slope - rate * slope_gradient(moved, data)
    return slope


class Reptile(eqx.Module):
    """The difference of the parameters before and after some plain gradient steps."""

    steps: int = eqx.field(static=True)
    rate: float = eqx.field(static=True)

    def __call__(self, loss, own, batch, key):
        first, _ = autodiff(loss, own, batch, key)

        def step(_, moved):
            gradient = autodiff(loss, moved, batch, key)[1]
            return jax.tree.map(lambda p, g: p - self.rate * g, moved, gradient)

        after = jax.lax.fori_loop(0, self.steps, step, own)
        return first, jax.tree.map(jnp.subtract, own, after)


def test_a_stage_may_have_an_update_that_is_not_a_gradient():
    """Reptile: the outer step goes a part of the way to where plain descent would end."""
    reptile = stage(draw=WholeData(), optimiser=optax.sgd(0.5), gradient=Reptile(5, 0.03))
    done = train_line([reptile], 2)
    expected, data = line(), points()
    for _ in range(2):
        inner = inner_sgd(expected, data, 5, 0.03)
        slope = np.asarray(expected.slope, np.float64)
        expected = eqx.tree_at(lambda m: m.slope, expected, slope + 0.5 * (inner - slope))
    np.testing.assert_allclose(done.model.slope, expected.slope, rtol=1e-5)
    first = np.linalg.norm(inner_sgd(line(), data, 5, 0.03))
    np.testing.assert_allclose(done.history.terms["gradient"][0], first, rtol=1e-5)


def test_stages_that_cannot_be_trained_are_refused():
    with pytest.raises(ValueError, match=r"different names, found \['slope', 'slope'\]"):
        train_line([stage(), stage()], 1)
    with pytest.raises(ValueError, match="stage 'none' has no leaf to learn"):
        train_line([stage("none", ())], 1)
    with pytest.raises(ValueError, match="every is 0; it must be at least 1"):
        stage(every=0)


def test_equal_stages_share_a_compiled_program():
    """A second run of equal shapes and settings traces nothing, however long it is."""
    traced = []

    class Counted(eqx.Module):
        def __call__(self, model, batch, key):
            traced.append(1)
            return ((model(batch.x) - batch.y) ** 2).mean()

    def stages():
        return two_stages(terms={"error": (1.0, Counted())}, optimiser=ADAM)

    train_line(stages(), 6)
    assert len(traced) == 2
    moved = eqx.tree_at(lambda m: m.slope, line(), jnp.ones(3))
    train(moved, points(), stages(), Schedule(9, seed=3), verbose=False)
    assert len(traced) == 2


def test_draws_depend_on_seed_and_step_alone():
    first, again = (train_line([stage()], 6) for _ in range(2))
    assert same(first.model, again.model)
    other = train(line(), points(), [stage()], Schedule(6, seed=1), verbose=False)
    assert not same(first.model, other.model)


def test_held_points_are_not_learned_from():
    held = stage(draw=DrawRows(8, held=10))
    data = points()
    spoilt = Points(data.x, data.y.at[-10:].multiply(-3.0))
    one, two = (train(line(), d, [held], Schedule(6), verbose=False) for d in (data, spoilt))
    assert same(one.model, two.model)
