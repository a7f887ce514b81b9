"""The paper's objective and step on fixed inputs, computed again by NumPy in float64."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SMPLX_PARENTS
from xavatar_jax.training import AvatarFields, objective
from xavatar_jax.training.batch import Batch
from xavatar_jax.training.step import make_optimiser, rate_factor

import xavatar_jax as xa
from xavatar_jax.body import bone_transforms
from xavatar_jax.correspondence import start_table
from xavatar_jax.fields import MLPGeometry, MLPShape, MLPSkinning

# Bones that start the search, by part label: body, face, left hand, right hand, eyes and mouth.
FACE = (12, 15, 22)
STARTS = (
    (0, 1, 2, 4, 5, 16, 17, 18, 19),
    FACE,
    (20, *range(25, 40)),
    (21, *range(40, 55)),
    FACE,
)
GATES = {0: 0, 9: 55, 15: 56, 20: 57, 21: 58}


def network(mlp, x, condition=None):
    """Rows of points through a weight-normalised network (X-Avatar's released code)."""
    octaves = [f(2.0**k * x) for k in range(mlp.shape.octaves) for f in (np.sin, np.cos)]
    encoded = h = np.concatenate([x, *octaves], axis=1)
    for k, layer in enumerate(mlp.layers):
        if k in mlp.shape.condition_at:
            embedded = np.asarray(mlp.embedding) @ condition + np.asarray(mlp.embedding_bias)
            h = np.concatenate([h, np.broadcast_to(embedded, (len(x), len(embedded)))], axis=1)
        if k in mlp.shape.skip:
            h = np.concatenate([h, encoded], axis=1) / np.sqrt(2)
        direction = np.asarray(layer.direction, np.float64)
        rows = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        h = h @ (rows * np.asarray(layer.length)[:, None]).T + np.asarray(layer.bias)
        if k < mlp.shape.depth:
            h = np.logaddexp(0, 100 * h) / 100
    return h


def weights(field, x):
    """Twenty times the logits, and mass that walks down the tree."""
    logits = 20 * network(field.mlp, x)
    found = np.zeros((len(x), 55))

    def walk(joint, mass):
        children = [k for k, parent in enumerate(SMPLX_PARENTS) if parent == joint]
        down = 0.0
        if children:
            down = 1 / (1 + np.exp(-logits[:, GATES.get(joint, children[0])]))
            share = np.exp(logits[:, children])
            share = share / share.sum(1, keepdims=True)
            for k, child in enumerate(children):
                walk(child, mass * down * share[:, k])
        found[:, joint] = mass * (1 - down)

    walk(0, np.ones(len(x)))
    return found


def skin(field, x, bones):
    blended = np.einsum("nj,jab->nab", weights(field, x), bones)
    return np.einsum("nab,nb->na", blended[:, :3, :3], x) + blended[:, :3, 3]


def broyden(field, target, start, bones):
    """Each row from its start: exact first Jacobian, at most 50 updates of its inverse."""
    x, step = start.copy(), 1e-6
    columns = [
        (skin(field, x + step * e, bones) - skin(field, x - step * e, bones)) / (2 * step)
        for e in np.eye(3)
    ]
    inverse = np.linalg.inv(np.stack(columns, -1))
    g = skin(field, x, bones) - target
    for _ in range(50):
        size = np.linalg.norm(g, axis=1)
        go = (size >= 1e-5) & (size < 1)
        dx = -np.einsum("nij,nj->ni", inverse, g)
        after = skin(field, x + dx, bones) - target
        dg = after - g
        row = np.einsum("ni,nij->nj", dx, inverse)
        below = (row * dg).sum(1)
        below = below + np.where(below < 0, -1e-6, 1e-6)
        change = (dx - np.einsum("nij,nj->ni", inverse, dg)) / below[:, None]
        update = inverse + change[:, :, None] * row[:, None]
        x, g = np.where(go[:, None], x + dx, x), np.where(go[:, None], after, g)
        inverse = np.where(go[:, None, None], update, inverse)
    return x, np.linalg.norm(g, axis=1) < 1e-5


def entropy(logit, target):
    return np.logaddexp(0, logit) - target * logit


@pytest.fixture
def small(family, x64):
    """Narrow networks of the paper's kind, two frames of points of every part, one of them lost."""
    body, tree = family["smplx"], family["smplx"].tree
    keys = jax.random.split(jax.random.key(5))
    plain = MLPShape(width=20, depth=3, octaves=0, skip=(), condition_at=())
    skinning = MLPSkinning(tree, plain, key=keys[0])
    geometry = MLPGeometry(tree, 10, MLPShape(width=64), key=keys[1])
    rng = np.random.default_rng(1)
    pose = np.deg2rad(15) * rng.standard_normal((2, 55, 3))
    params = xa.BodyParams.create(body, pose=pose, expression=rng.normal(size=(2, 10)))
    pose_bones = jax.jit(jax.vmap(lambda p: bone_transforms(body, p)))
    bones = np.asarray(pose_bones(params), np.float64)
    parts = np.tile(np.arange(5), (2, 6))
    x_c = rng.uniform(-0.6, 0.6, (2, 30, 3))
    points = np.stack([skin(skinning, x_c[k], bones[k]) for k in range(2)])
    points[1, 7] = 9.0  # no bone leads from there to anywhere: it has no root
    none = np.zeros((2, 0, 0))
    batch = Batch(
        *(jnp.asarray(v) for v in (points, parts, rng.normal(size=(2, 30)), 0 * points)),
        jnp.ones((2, 30), bool), jnp.zeros((*none.shape, 3)), jnp.asarray(none, bool),
        jnp.asarray(bones), params,
    )  # fmt: skip
    return body, AvatarFields(skinning, geometry), batch


def reference(body, fields, batch, on_bones, anchors):
    """Every term of the objective, from the stages above."""
    logits, targets, count = [], [], 0
    for k in range(2):
        pose, expression = batch.params.pose[k], batch.params.expression[k]
        condition = np.concatenate([np.ravel(pose[1:22]) / np.pi, expression])
        bones, points = np.asarray(batch.transforms[k]), np.asarray(batch.points[k])
        rows = [(i, b) for i, part in enumerate(np.asarray(batch.parts[k])) for b in STARTS[part]]
        of, bone = np.array(rows).T
        inverse = np.linalg.inv(bones[bone])
        start = np.einsum("nab,nb->na", inverse[:, :3, :3], points[of]) + inverse[:, :3, 3]
        roots, valid = broyden(fields.skinning, points[of], start, bones)
        at_roots = network(fields.geometry.mlp, roots, condition)[:, 0]
        best = np.full(len(points), -np.inf)
        np.maximum.at(best, of[valid], at_roots[valid])
        found = np.isfinite(best)
        count += found.sum()
        logits.append(best[found])
        targets.append(np.asarray(batch.distance[k])[found] > 0)
        if k == 0:
            bone_logit = network(fields.geometry.mlp, on_bones, condition)[:, 0]
    at_joints = weights(fields.skinning, np.asarray(anchors.joints, np.float64))
    own, parents = np.eye(55), np.eye(55)[list(SMPLX_PARENTS[1:])]
    hands_and_face = np.isin(np.asarray(body.part_labels), (1, 2, 3))
    wanted = np.asarray(body.weights, np.float64)[hands_and_face]
    at_surface = weights(fields.skinning, np.asarray(anchors.surface, np.float64))
    terms = {
        "occupancy": entropy(np.concatenate(logits), np.concatenate(targets)).mean(),
        "bone": entropy(bone_logit, 1.0).mean(),
        "joint": np.concatenate([(at_joints - own) ** 2, (at_joints[1:] - parents) ** 2]).mean(),
        "surface": ((at_surface - wanted) ** 2).mean(),
    }
    total = terms["occupancy"] + terms["bone"] + 10 * terms["joint"] + 10 * terms["surface"]
    return total, {**terms, "found": count / 60}


def test_the_objective_is_that_of_the_paper(small, monkeypatch, rng):
    """Search from the published bones, largest logit, and the four terms with their weights."""
    body, fields, batch = small
    config = xa.paper()
    anchors = objective.make_anchors(body, jnp.zeros(10), config)
    on_bones = rng.uniform(-0.5, 0.5, (270, 3))
    monkeypatch.setattr(objective, "bone_points", lambda *_: jnp.asarray(on_bones))
    ask = jax.jit(lambda f: objective.full_objective(f, batch, anchors, config, jax.random.key(0)))
    total, terms = ask(fields)
    expected, expected_terms = reference(body, fields, batch, on_bones, anchors)
    assert 0.8 < expected_terms["found"] < 1
    assert set(terms) == set(expected_terms)
    for name, value in expected_terms.items():
        np.testing.assert_allclose(terms[name], value, rtol=2e-5, err_msg=name)
    np.testing.assert_allclose(total, expected, rtol=2e-5)


def test_each_part_starts_from_the_published_bones(family):
    table = start_table(family["smplx"].tree, xa.paper().search.starts)
    for row, bones in enumerate(STARTS):
        assert tuple(np.asarray(table.index)[row][np.asarray(table.mask)[row]]) == bones


def test_steps_are_adam_after_one_clip(rng):
    """The optimiser of the preset against the update written out; a step times the rate."""
    config = xa.paper()
    assert config.optimiser.skinning_rate == config.optimiser.learning_rate == 1e-3
    assert rate_factor(config, jnp.asarray(40_000), jnp.asarray(45_000)) == 1
    optimiser = make_optimiser(config)
    value = {"a": np.zeros(4), "b": np.zeros((2, 3))}
    state = optimiser.init(jax.tree.map(lambda v: jnp.asarray(v, jnp.float32), value))
    first, second = (jax.tree.map(np.zeros_like, value) for _ in range(2))
    for k in range(1, 6):
        size = 10.0 ** (k - 4)  # below the clip at first, above it later
        gradient = jax.tree.map(lambda v, s=size: s * rng.normal(size=v.shape), value)
        update, state = optimiser.update(
            jax.tree.map(lambda v: jnp.asarray(v, jnp.float32), gradient), state
        )
        norm = np.sqrt(sum((v**2).sum() for v in gradient.values()))
        for name in value:
            g = gradient[name] * min(1.0, 0.1 / norm)
            first[name] = 0.9 * first[name] + 0.1 * g
            second[name] = 0.999 * second[name] + 0.001 * g**2
            mean, square = first[name] / (1 - 0.9**k), second[name] / (1 - 0.999**k)
            expected = mean / (np.sqrt(square) + 1e-8)
            np.testing.assert_allclose(update[name], expected, rtol=1e-4, atol=1e-6)


def test_the_published_numbers():
    """Counts, weights and schedule of the SMPL-X configuration for GRAB."""
    config = xa.paper()
    plan, losses, search = config.points, config.losses, config.search
    assert (config.steps, config.frames_per_step, config.points_per_step) == (45_000, 4, 6000)
    assert (plan.body, plan.face, plan.eyes_mouth, plan.hand) == (2000, 1000, 1000, 1000)
    assert (plan.box, plan.sigma, plan.fine_sigma, plan.by_vertex) == (0, (0.01,), (0.01,), True)
    assert (losses.softness, losses.bone, losses.joint, losses.surface) == (0, 1, 10, 10)
    assert (losses.surface_parts, losses.surface_points) == ("hands_face", 0)
    assert (search.atol, search.max_steps, search.cached) == (1e-5, 50, False)
    assert (config.optimiser.schedule, config.optimiser.clip) == ("constant", 0.1)
    assert config.optimiser.warmup == 1000  # ours: docs/options.md says why
    assert config.optimiser.learning_rate == 1e-3
    assert config.skinning.mlp == replace(MLPShape(), width=128, depth=5, octaves=0, skip=(),
                                          condition_at=())  # fmt: skip
    assert config.geometry.mlp == MLPShape(512, 8, 4, (4,), (0,), 16)
