"""The objectives of stored roots, by which `quick` learns, beside the same sums in NumPy."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.fields import AbstractGeometryField, AbstractSkinningField
from xavatar_jax.kinematics import KinematicTree
from xavatar_jax.training import AvatarFields, objective
from xavatar_jax.training.batch import Batch

TREE = KinematicTree(("root", "tip"), (-1, 0))
SLOPE, SHARP, SOFT = np.array([9.0, -4.0, 2.0]), 400.0, 0.004
SHIFT = np.array([0.2, 0.3])  # of each frame: the root's bone to the right, the tip's to the left
PLACES = np.array([-0.1, 0.05, 0.0, 0.1, -0.03])  # of the posed points, along x
EXPRESSION = np.array([[0.5], [-1.5]])
# Which root is stored first (-1: that of the root's bone, on the left), and whether the other is.
FIRST = np.array([[-1, 1, 1, -1, 1], [1, -1, 1, 1, -1]])
SECOND = np.array([[True, True, False], [True, False, True]])
ROOTED = np.array([[True] * 5, [True, True, True, True, False]])


class Plane(AbstractGeometryField):
    """A logit that rises along one direction and with the first coefficient of expression."""

    slope: jax.Array

    def condition(self, params):
        return params.expression[0]

    def __call__(self, x_c, condition):
        return self.slope @ x_c + condition


class Halves(AbstractSkinningField):
    """What is left moves with the root, what is right with its tip."""

    sharp: jax.Array

    def __call__(self, x_c):
        tip = jax.nn.sigmoid(self.sharp * x_c[0])
        return jnp.stack([1 - tip, tip])

    def covers(self, x_c):
        return jnp.asarray(True)


@pytest.fixture
def stored(x64, rng):
    across = rng.normal(size=(2, 5, 2))
    points = np.concatenate([np.tile(PLACES, (2, 1))[..., None], across], axis=-1)
    by_side = {
        side: points + side * SHIFT[:, None, None] * np.array([1.0, 0, 0]) for side in (-1, 1)
    }
    root = np.where(FIRST[..., None] < 0, by_side[-1], by_side[1])
    other = np.where(FIRST[..., None] < 0, by_side[1], by_side[-1])[:, :3]
    # A third that is none, and would have by far the largest logit.
    others = np.stack([other, np.full_like(other, 50.0) * [1, -1, 1]], axis=2)
    valid = np.stack([SECOND, np.zeros_like(SECOND)], axis=2)
    bones = np.tile(np.eye(4), (2, 2, 1, 1))
    bones[:, 0, 0, 3], bones[:, 1, 0, 3] = SHIFT, -SHIFT
    distance = rng.normal(size=(2, 5)) * 0.005
    params = xa.BodyParams(
        pose=jnp.zeros((2, 2, 3)), betas=jnp.zeros((2, 0)), expression=jnp.asarray(EXPRESSION),
        transl=jnp.zeros((2, 3)), tree=TREE,
    )  # fmt: skip
    batch = Batch(
        *(jnp.asarray(v) for v in (points, np.zeros((2, 5), int), distance, root, ROOTED)),
        *(jnp.asarray(v) for v in (others, valid, bones)), params,
    )  # fmt: skip
    logit = root @ SLOPE + EXPRESSION
    logit[:, :3] = np.maximum(logit[:, :3], np.where(SECOND, other @ SLOPE + EXPRESSION, -np.inf))
    return batch, logit, distance


def divergence(logit, distance):
    """Of the field's occupancy from that of a logistic step, in nats."""
    p, q = (1 / (1 + np.exp(-v)) for v in (distance / SOFT, logit))
    return p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))


def test_the_terms_are_those_of_the_best_roots(x64, stored, monkeypatch, rng):
    batch, logit, distance = stored
    on_bones = rng.normal(size=(5, 3))
    monkeypatch.setattr(objective, "bone_points", lambda *_: jnp.asarray(on_bones))
    joints, surface = np.array([[0.0, 0, 0], [0.4, 0, 0]]), rng.normal(size=(4, 3))
    template = np.array([[1.0, 0], [0.5, 0.5], [0, 1], [0.3, 0.7]])
    anchors = objective.Anchors(*(jnp.asarray(v) for v in (joints, surface, template)), TREE)
    quick = xa.quick()
    config = replace(quick, losses=replace(quick.losses, softness=SOFT, surface_points=0))
    fields = AvatarFields(Halves(jnp.asarray(SHARP)), Plane(jnp.asarray(SLOPE)))
    each = np.where(ROOTED, divergence(logit, distance), 0)

    total, terms = objective.geometry_objective(fields, batch, anchors, config, jax.random.key(0))
    bone = np.logaddexp(0, -(on_bones @ SLOPE + EXPRESSION[0])).mean()
    np.testing.assert_allclose(terms["occupancy"], each.mean(), rtol=1e-6)
    np.testing.assert_allclose(terms["bone"], bone, rtol=1e-6)
    np.testing.assert_allclose(total, each.mean() + quick.losses.bone * bone, rtol=1e-6)

    total, terms = objective.skinning_objective(fields, batch, anchors, config, jax.random.key(0))
    tip = 1 / (1 + np.exp(-SHARP * np.concatenate([joints, surface])[:, 0]))
    weights = np.stack([1 - tip, tip], axis=1)
    wanted = np.array([[1.0, 0], [0, 1], [1, 0]])  # the tip's joint is shared with its parent
    joint = ((weights[[0, 1, 1]] - wanted) ** 2).mean()
    held = ((weights[2:] - template) ** 2).mean()
    occupancy = each.sum() / ROOTED.sum()
    np.testing.assert_allclose(terms["skinning_occupancy"], occupancy, rtol=1e-6)
    np.testing.assert_allclose(terms["skinning_joint"], joint, rtol=1e-6)
    np.testing.assert_allclose(terms["skinning_surface"], held, rtol=1e-6)
    whole = occupancy + quick.losses.joint * joint + quick.losses.surface * held
    np.testing.assert_allclose(total, whole, rtol=1e-6)
