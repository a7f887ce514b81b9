"""What a step draws and its terms: beside the same sums in NumPy, and finite differences."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import same

import xavatar_jax as xa
from xavatar_jax.fields import (
    AbstractPlainGeometry,
    AbstractSkinningField,
    AvatarModel,
    GeometryValue,
    Occupancy,
)
from xavatar_jax.kinematics import KinematicTree
from xavatar_jax.learning import FALLING, Schedule, train
from xavatar_jax.methods.xavatar.roots import FrameData, RootCache
from xavatar_jax.methods.xavatar.stages import (
    BoneTerm,
    DrawCached,
    DrawnPoints,
    FoundTerm,
    JointTerm,
    LevelsAtRoots,
    LevelTerm,
    RowDraw,
    SurfaceWeightsTerm,
    ValidationLoss,
    optimiser_of,
    training_stages,
    validation_loss,
)
from xavatar_jax.sampling import VolumePoints, bone_points

TREE = KinematicTree(("root", "tip"), (-1, 0))
SLOPE, SHARP, SOFT = np.array([9.0, -4.0, 2.0]), 400.0, 0.004
SHIFT = np.array([0.2, 0.3])  # of each frame: the root's bone to the right, the tip's to the left
PLACES = np.array([-0.1, 0.05, 0.0, 0.1, -0.03])  # of the posed points, along x
EXPRESSION = np.array([[0.5], [-1.5]])
KEY = jax.random.key(0)


class Plane(AbstractPlainGeometry):
    """A logit that rises along one direction and with the first coefficient of expression."""

    slope: jax.Array

    def condition(self, params):
        return params.expression[0]

    def __call__(self, x_c, condition):
        return GeometryValue(self.slope @ x_c + condition)


class Halves(AbstractSkinningField):
    """What is left moves with the root, what is right with its tip."""

    sharp: jax.Array

    def __call__(self, x_c):
        tip = jax.nn.sigmoid(self.sharp * x_c[0])
        return jnp.stack([1 - tip, tip])

    def covers(self, x_c):
        return jnp.asarray(True)


def model_of(sharp=SHARP):
    return AvatarModel(
        skinning=Halves(jnp.asarray(sharp)),
        geometry=Plane(jnp.asarray(SLOPE)),
        link=Occupancy(SOFT),
    )


def bones_of():
    bones = np.tile(np.eye(4), (2, 2, 1, 1))
    bones[:, 0, 0, 3], bones[:, 1, 0, 3] = SHIFT, -SHIFT
    return jnp.asarray(bones)


def params_of(count=2):
    return xa.BodyParams(
        pose=jnp.zeros((count, 2, 3)), betas=jnp.zeros((count, 0)),
        expression=jnp.asarray(EXPRESSION[:count]), transl=jnp.zeros((count, 3)), tree=TREE,
    )  # fmt: skip


@pytest.fixture
def stored(x64, rng):
    """Five rows a frame: three with both roots, one with one, one with one or with none."""
    across = rng.normal(size=(2, 5, 2))
    points = np.concatenate([np.tile(PLACES, (2, 1))[..., None], across], axis=-1)
    move = SHIFT[:, None, None] * np.array([1.0, 0, 0])
    left, right = points - move, points + move
    # A third that is none, and would have by far the largest logit.
    others = np.stack([right[:, :3], np.full((2, 3, 3), 50.0) * [1, -1, 1]], axis=2)
    valid = np.zeros((2, 3, 2), bool)
    valid[..., 0] = True
    valid[0, 2, 0] = False  # vanished
    first_valid = np.array([[True] * 5, [True, True, True, True, False]])
    distance = rng.normal(size=(2, 5)) * 0.005
    cache = RootCache(
        first=jnp.asarray(left), neutral=jnp.asarray(left), valid=jnp.asarray(first_valid),
        others=jnp.asarray(others), others_neutral=jnp.asarray(others),
        others_valid=jnp.asarray(valid), found=jnp.asarray([5, 4]), several=jnp.asarray([3, 3]),
        share=jnp.asarray(6 / 9),
    )  # fmt: skip
    samples = VolumePoints(jnp.asarray(points), jnp.zeros((2, 5), int), jnp.asarray(distance))
    data = FrameData(samples, bones_of(), params_of(), roots=cache)
    logit = left @ SLOPE + EXPRESSION
    second = np.where(valid[..., 0], right[:, :3] @ SLOPE + EXPRESSION, -np.inf)
    logit[:, :3] = np.maximum(logit[:, :3], second)
    return data, np.where(first_valid, logit, np.nan)


def divergence(logit, distance):
    """Of the field's occupancy from that of a logistic step, in nats."""
    p, q = (1 / (1 + np.exp(-v)) for v in (distance / SOFT, logit))
    return p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))


def rows_of(batch, data):
    """Frame and row of each drawn point."""
    known = np.asarray(data.samples.x_d)
    return [
        [np.argwhere((known == p).all(-1))[0] for p in frame] for frame in np.asarray(batch.x_d)
    ]


def test_the_level_is_that_of_the_best_root_and_lost_points_count_for_nothing(stored):
    data, logit = stored
    draw = DrawCached(RowDraw(frames=4, points=9, several=5, held=0))
    model = model_of()
    drawn = draw(model, data, jax.random.key(4))
    batch = LevelsAtRoots(False, TREE)(model, drawn, KEY)
    at = np.array(rows_of(batch, data))
    assert (at[:, :, 0] == at[:, :1, 0]).all()  # a frame's points are its own
    assert (at[:, :5, 1] < 3).all()
    assert (at[:, 5:, 1] >= 3).all()
    expected = logit[at[..., 0], at[..., 1]]
    assert np.array_equal(np.isfinite(expected), batch.found)
    found = np.isfinite(expected)
    level = np.asarray(batch.x_c) @ SLOPE + np.asarray(batch.params.expression)
    np.testing.assert_allclose(level[found], expected[found], rtol=1e-9)
    each = divergence(expected, np.asarray(data.samples.distance)[at[..., 0], at[..., 1]])
    np.testing.assert_allclose(np.asarray(batch.level)[found], expected[found], rtol=1e-9)
    for through in (False, True):
        again = LevelsAtRoots(through, TREE)(model, drawn, KEY)
        np.testing.assert_allclose(again.x_c, batch.x_c, atol=1e-9)
        total, count = LevelTerm()(model, again, KEY)
        np.testing.assert_allclose(total / count, np.nanmean(each), rtol=1e-6)
    assert FoundTerm()(model, batch, KEY) == pytest.approx(found.mean())
    # Wherever a lost point stands, losses and slopes are the same.
    elsewhere = drawn._replace(
        root=jnp.where(drawn.valid[..., None], drawn.root, 7.0),
        neutral=jnp.where(drawn.valid[..., None], drawn.neutral, 7.0),
        others=jnp.where(drawn.others_valid[..., None], drawn.others, -7.0),
        others_neutral=jnp.where(drawn.others_valid[..., None], drawn.others, -7.0),
    )

    for through in (False, True):
        loss = lambda model, drawn, t=through: level_loss(model, drawn, t)  # noqa: E731
        assert same(*(jax.value_and_grad(loss)(model, d) for d in (drawn, elsewhere)))


def level_loss(model, drawn, through):
    total, count = LevelTerm()(model, LevelsAtRoots(through, TREE)(model, drawn, KEY), KEY)
    return total / count


def drawn_points(x_d, root, distance, bones, params):
    """Points with one root each."""
    frames, points = x_d.shape[:2]
    return DrawnPoints(
        x_d=jnp.asarray(x_d), root=jnp.asarray(root), neutral=jnp.asarray(root),
        part=jnp.zeros((frames, points), int),
        distance=jnp.asarray(distance), valid=jnp.ones((frames, points), bool),
        others=jnp.zeros((frames, 0, 1, 3)), others_neutral=jnp.zeros((frames, 0, 1, 3)),
        others_valid=jnp.zeros((frames, 0, 1), bool),
        transforms=bones, params=params,
    )  # fmt: skip


def test_the_weight_terms_are_those_of_numpy(x64, rng):
    joints, surface = np.array([[0.0, 0, 0], [0.4, 0, 0]]), rng.normal(size=(4, 3))
    template = np.array([[1.0, 0], [0.5, 0.5], [0, 1], [0.3, 0.7]])
    tip = 1 / (1 + np.exp(-SHARP * np.concatenate([joints, surface])[:, 0]))
    weights = np.stack([1 - tip, tip], axis=1)
    wanted = np.array([[1.0, 0], [0, 1], [1, 0]])  # the tip's joint is shared with its parent
    joint = JointTerm(jnp.asarray(joints), TREE)(model_of(), None, KEY)
    np.testing.assert_allclose(joint, ((weights[[0, 1, 1]] - wanted) ** 2).mean(), rtol=1e-6)
    term = SurfaceWeightsTerm(jnp.asarray(surface), jnp.asarray(template), 0)
    held = ((weights[2:] - template) ** 2).mean()
    np.testing.assert_allclose(term(model_of(), None, KEY), held, rtol=1e-6)
    few = replace(term, count=2)
    values = {float(few(model_of(), None, jax.random.key(k))) for k in range(20)}
    each = ((weights[2:] - template) ** 2).mean(1)
    possible = {round((a + b) / 2, 12) for a in each for b in each}
    assert len(values) > 1
    assert {round(v, 12) for v in values} <= possible


def test_bone_points_are_inside_in_the_condition_of_every_frame(x64):
    """Shared out in turn: the first goes to the first frame, the second to the second, ..."""
    joints = jnp.asarray([[0.0, 0, 0], [0.4, 0, 0]])
    frames = jnp.zeros((2, 1, 3))
    drawn = drawn_points(frames, frames, frames[..., 0], bones_of(), params_of())
    batch = LevelsAtRoots(False, TREE, joints)(model_of(), drawn, KEY)
    found = BoneTerm()(model_of(), batch, KEY)
    inside = np.asarray(bone_points(TREE, joints, KEY))
    of = np.arange(len(inside)) % 2
    logit = inside @ SLOPE + EXPRESSION[of, 0]
    np.testing.assert_allclose(found, np.logaddexp(0, -logit).mean(), rtol=1e-6)


def test_the_level_follows_the_root_that_the_field_moves(x64):
    """Against central differences through a Newton solve of each point's root."""
    sharp, target = 5.0, np.array([[[0.05, 0.2, -0.1], [-0.04, 0.0, 0.3]]])
    bones, params = bones_of()[:1] * 1.0, params_of(1)
    bones = bones.at[:, :, 0, 3].multiply(0.2)
    distance = np.array([[0.003, -0.002]])

    def root(sharp):
        x = target[0, :, 0].copy()
        for _ in range(50):
            tip = 1 / (1 + np.exp(-sharp * x))
            shift = 0.04 * (1 - tip) - 0.04 * tip
            slope = 1 - 0.08 * sharp * tip * (1 - tip)
            x = x - (x + shift - target[0, :, 0]) / slope
        return np.concatenate([x[:, None], target[0, :, 1:]], 1)

    def expected(sharp):
        return divergence(root(sharp) @ SLOPE + EXPRESSION[0], distance[0]).mean()

    drawn = drawn_points(target, root(sharp)[None], distance, bones, params)

    def loss(sharp, through):
        return level_loss(model_of(sharp), drawn, through)

    value, slope = jax.value_and_grad(loss)(jnp.asarray(sharp), True)
    np.testing.assert_allclose(value, expected(sharp), rtol=1e-9)
    difference = (expected(sharp + 1e-5) - expected(sharp - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    assert jax.grad(loss)(jnp.asarray(sharp), False) == 0


def stages_of(case, data=None, *, held=0, extra=None, **changes):
    config = case.config
    options = {
        "search": config.search, "losses": config.losses, "optimiser": config.optimiser,
        "frames": config.frames_per_step, "points": config.points_per_step,
        "skinning_points": config.skinning_points, "skinning_every": config.skinning_every,
        "learn_skinning": True, **changes,
    }  # fmt: skip
    data = case.data if data is None else data
    betas = np.zeros(case.body.num_betas)
    return training_stages(case.body, betas, data, held=held, extra=extra, **options)


def test_stages_of_cached_roots_take_turns(case):
    geometry, skinning = stages_of(case)
    assert (geometry.name, skinning.name, skinning.every) == ("geometry", "skinning", 4)
    assert set(geometry.terms) == {"occupancy", "bone"}
    assert set(skinning.terms) == {"occupancy", "joint", "surface"}
    assert geometry.schedule is skinning.schedule is FALLING
    assert [s.name for s in stages_of(case, learn_skinning=False)] == ["geometry"]


@pytest.mark.parametrize("name", ["loss", "occupancy", "skinning_surface", "validation"])
def test_names_of_the_library_are_refused(case, name):
    with pytest.raises(ValueError, match=name):
        stages_of(case, extra={name: (1.0, lambda model, batch, key: jnp.zeros(()))})


def test_only_learned_leaves_change(case):
    schedule = Schedule(6, report_every=1)
    done = train(case.model, case.data, stages_of(case), schedule, verbose=False)
    before, after = case.model, done.model
    assert not np.array_equal(before.geometry.encoding.table, after.geometry.encoding.table)
    assert not np.array_equal(before.skinning.correction, after.skinning.correction)
    assert same(before.skinning.template, after.skinning.template)
    still = train(
        case.model, case.data, stages_of(case, learn_skinning=False), schedule, verbose=False
    )
    assert same(before.skinning, still.model.skinning)
    assert not any(name.startswith("skinning") for name in still.history.terms)


def test_steps_are_adam_after_one_clip(case, rng):
    """The paper's optimiser against the update written out, with the rise of its rate."""
    options = replace(xa.paper().optimiser, warmup=4)
    rates = {"skinning": options.skinning_rate, "geometry": options.learning_rate}
    optimiser = optimiser_of(options)
    model = eqx.filter(model_of(), eqx.is_inexact_array)
    model = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), model)
    state = optimiser.init(model)
    shapes = {"skinning": (), "geometry": (3,)}
    first, second = ({n: np.zeros(s) for n, s in shapes.items()} for _ in range(2))
    for k in range(1, 7):
        size = 10.0 ** (k - 4)  # below the clip at first, above it later
        gradient = {n: size * rng.normal(size=s) for n, s in shapes.items()}
        given = eqx.tree_at(
            lambda m: (m.skinning.sharp, m.geometry.slope), model,
            tuple(jnp.asarray(v, jnp.float32) for v in gradient.values()),
        )  # fmt: skip
        update, state = optimiser.update(given, state, model)
        norm = np.sqrt(sum((v**2).sum() for v in gradient.values()))
        for name, found in (
            ("skinning", update.skinning.sharp), ("geometry", update.geometry.slope)
        ):  # fmt: skip
            g = gradient[name] * min(1.0, 0.1 / norm)
            first[name] = 0.9 * first[name] + 0.1 * g
            second[name] = 0.999 * second[name] + 0.001 * g**2
            mean, square = first[name] / (1 - 0.9**k), second[name] / (1 - 0.999**k)
            rate = rates[name] * min(k / 4, 1.0)
            expected = -rate * mean / (np.sqrt(square) + 1e-8)
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)


def test_validation_is_the_loss_at_the_roots_of_the_held_frames(case):
    """Against the cross-entropy computed by NumPy at roots that are exact."""
    roots = case.data.roots
    data = replace(case.data, roots=replace(roots, share=jnp.zeros(())))  # rows with one alone
    count = 4000
    stages = stages_of(case, data, held=1)
    draw = stages[0].draw
    loss = validation_loss(stages, data, case.model.link, points=count, held=1)
    batch = draw.of_frames(case.model, data, jnp.asarray([2]), KEY)
    assert batch.x_d.shape[0] == 1
    several, found = int(roots.several[2]), int(roots.found[2])
    where = np.asarray(roots.first[2, several:found])
    condition = case.model.geometry.condition(jax.tree.map(lambda v: v[2], data.params))
    level = np.asarray(jax.vmap(lambda x: case.model.geometry(x, condition).level)(where), float)
    scaled = np.asarray(data.samples.distance[2, several:found], float) / SOFT

    def entropy(z, t):
        return np.logaddexp(0, z) - z * t

    target = 1 / (1 + np.exp(-scaled))
    expected = (entropy(level, target) - entropy(scaled, target)).mean()
    # Points are drawn with repetition.
    assert float(loss(case.model, data)) == pytest.approx(expected, rel=0.2)


def test_the_validation_loss_does_not_fall_as_roots_vanish(stored):
    """A point that loses its root counts with the last place of that root."""
    data, _ = stored
    deep = replace(data, samples=data.samples._replace(distance=jnp.full((2, 5), 0.02)))
    model = model_of()
    rows = RowDraw(frames=1, points=4, several=2, held=1)
    loss = ValidationLoss(DrawCached(rows), LevelsAtRoots(True, TREE), model.link)
    gone = eqx.tree_at(
        lambda d: (d.roots.valid, d.roots.others_valid), deep,
        (jnp.zeros((2, 5), bool), jnp.zeros((2, 3, 2), bool)),
    )  # fmt: skip
    first = eqx.tree_at(lambda d: d.roots.others_valid, deep, jnp.zeros((2, 3, 2), bool))
    np.testing.assert_allclose(loss(model, gone), loss(model, first), rtol=1e-6)
    # Of several roots the most inside one counts: losing the others cannot help.
    assert float(loss(model, gone)) >= float(loss(model, deep)) > 0


def test_the_validation_loss_keeps_points_where_the_map_folds(stored):
    """They count with the root that was found, which is at the fold itself, x = 0."""
    data, _ = stored
    zero = jnp.zeros((2, 5, 3))
    cache = replace(data.roots, first=zero, neutral=zero, others_valid=jnp.zeros((2, 3, 2), bool))
    deep = replace(
        data, roots=cache, samples=data.samples._replace(distance=jnp.full((2, 5), 0.02))
    )
    draw = DrawCached(RowDraw(frames=1, points=4, several=2, held=1))
    loss = ValidationLoss(draw, LevelsAtRoots(True, TREE), Occupancy(SOFT))
    expected = divergence(EXPRESSION[1, 0], 0.02)
    # The slope of the map at x = 0 is 1 - shift * sharp / 2.
    for slope in (0.0, -0.025, 0.04):
        sharp = 2 * (1 - slope) / SHIFT[1]
        np.testing.assert_allclose(loss(model_of(sharp), deep), expected, rtol=1e-6)
