"""SCANimate's terms against NumPy in float64, its networks, and its stages on known answers."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TOLERANCE, TREES
from scipy.spatial.transform import Rotation

import xavatar_jax as xa
from xavatar_jax.baselines.scanimate import ShapeWeights, Stage, losses, scanimate_quick
from xavatar_jax.baselines.scanimate.fields import (
    InverseSkinning,
    LocalPoseMLP,
    SoftmaxSkinning,
    adjacency,
    quaternions,
)
from xavatar_jax.baselines.scanimate.fit import learning_rate
from xavatar_jax.baselines.scanimate.hands import static_hands
from xavatar_jax.baselines.scanimate.objective import (
    CanonicalScans,
    SkinNets,
    Template,
    shape_objective,
    skin_objective,
)
from xavatar_jax.baselines.scanimate.scans import Scans, edge_stretch, nearest_weights
from xavatar_jax.body import canonical_pose, pose_body
from xavatar_jax.fields import AbstractGeometryField, AbstractSkinningField, MLPShape
from xavatar_jax.kinematics import KinematicTree

TREE = KinematicTree(("a", "b", "c"), (-1, 0, 1))
SMALL = MLPShape(width=16, depth=2, octaves=2, skip=(), condition_at=(0,), condition_embedding=8)


class Constant(AbstractSkinningField):
    """The same weights everywhere."""

    weights: jax.Array

    def __call__(self, x_c):
        return self.weights

    def covers(self, x_c):
        return jnp.asarray(True)


class Ball(AbstractGeometryField):
    """Its logit is the distance to the sphere of radius one half, positive inside, over 4 mm."""

    def condition(self, params):
        return params.transl

    def __call__(self, x_c, condition):
        return (0.5 - jnp.sqrt((x_c**2).sum() + 1e-12)) / 0.004


def random_transforms(rng, count, joints=3):
    transforms = np.tile(np.eye(4), (count, joints, 1, 1))
    turns = Rotation.from_rotvec(0.5 * rng.standard_normal((count * joints, 3))).as_matrix()
    transforms[..., :3, :3] = turns.reshape(count, joints, 3, 3)
    transforms[..., :3, 3] = 0.1 * rng.standard_normal((count, joints, 3))
    return transforms


def toy_params(count):
    pose = jnp.zeros((count, 3, 3))
    return xa.BodyParams(pose, jnp.zeros((count, 0)), jnp.zeros((count, 0)), pose[:, 0], TREE)


def test_terms_are_those_of_numpy(rng, x64):
    w, v = (rng.dirichlet(np.ones(5), (4, 3)) for _ in range(2))
    w[0, 0] = [1, 0, 0, 0, 0]
    x, y = rng.standard_normal((2, 7, 3))
    d = 0.03 * rng.standard_normal(9)
    expected = {
        "weight_error": ((w - v) ** 2).mean(),
        "sparsity": np.mean([[sum(abs(n) ** 0.8 for n in p) for p in row] for row in w]),
        "latent_size": np.linalg.norm(x, axis=1).mean(),
        "cycle_error": np.abs(x - y).mean(),
        "edge_difference": np.mean(
            [np.abs(t[a] - t[b]).sum() for t in w for a, b in ((0, 1), (1, 2), (2, 0))]
        ),
        "normal_error": np.linalg.norm(x - y, axis=1).mean(),
        "eikonal_error": ((np.linalg.norm(x, axis=1) - 1) ** 2).mean(),
        "nearness": np.exp(-100 * np.abs(d)).mean(),
        "wrong_side": np.where(d < 0, -d, 0).mean(),
    }
    given = {
        "weight_error": (w, v), "sparsity": (w,), "latent_size": (x,), "cycle_error": (x, y),
        "edge_difference": (w,), "normal_error": (x, y), "eikonal_error": (x,), "nearness": (d,),
        "wrong_side": (d,),
    }  # fmt: skip
    for name, arrays in given.items():
        found = getattr(losses, name)(*map(jnp.asarray, arrays))
        # A weight of zero counts as 1e-6, to the power of 0.8.
        atol = 1e-5 if name == "sparsity" else 1e-12
        np.testing.assert_allclose(found, expected[name], atol=atol)


@pytest.mark.parametrize("name", ["sparsity", "latent_size", "normal_error", "eikonal_error"])
def test_terms_have_finite_slopes_at_zero(name):
    zeros = jnp.zeros((2, 3))
    term = getattr(losses, name)
    slope = jax.grad(lambda x: term(x, zeros) if name == "normal_error" else term(x))(zeros)
    assert jnp.isfinite(slope).all()


def test_quaternions_and_adjacency(rng):
    vectors = np.concatenate([rng.standard_normal((6, 3)), np.zeros((1, 3))])
    expected = Rotation.from_rotvec(vectors).as_quat()[:, [3, 0, 1, 2]]
    expected *= np.sign(expected[:, :1])
    np.testing.assert_allclose(quaternions(jnp.asarray(vectors)), expected, atol=2e-6)
    heard, tree = adjacency(TREES["smplx"]), TREES["smplx"]
    np.testing.assert_allclose(heard.sum(1), 1, atol=1e-12)
    knee, order = tree.index("left_knee"), heard[tree.index("left_knee")]
    assert order[knee] > order[tree.index("left_ankle")] > order[tree.index("left_foot")] > 0
    assert order[tree.index("left_hip")] == order[tree.index("left_ankle")]
    # pelvis is two steps away, neck seven.
    assert order[tree.index("pelvis")] > 0
    assert order[tree.index("neck")] == 0


def test_networks_give_weights_and_a_local_condition(rng):
    key = jax.random.key(0)
    forward = SoftmaxSkinning(TREE, replace(SMALL, condition_at=()), key=key)
    inverse = InverseSkinning(TREE, SMALL, frames=2, latent=4, known=True, key=key)
    known = jnp.asarray(rng.dirichlet(np.ones(3)))
    x = jnp.asarray([0.1, 0.2, -0.3])
    np.testing.assert_allclose(forward(x).sum(), 1, atol=TOLERANCE["sum_to_one"])
    # Silent at first: the known weights, a ten-thousandth for each bone added.
    expected = (np.asarray(known) + 1e-4) / (1 + 3e-4)
    np.testing.assert_allclose(inverse(x, inverse.latents[0], known), expected, atol=1e-6)

    # A chain of eight: the last joint is out of the first one's hearing.
    chain = KinematicTree(tuple("abcdefgh"), (-1, *range(7)))
    weights = Constant(jnp.eye(8)[0])
    network = LocalPoseMLP(chain, weights, SMALL, softness=0.004, key=key)
    # The pose is silent at first: let the first layer hear all of its inputs.
    first = network.mlp.layers[0].direction
    loud = jnp.asarray(rng.standard_normal(first.shape), first.dtype)
    network = eqx.tree_at(lambda n: n.mlp.layers[0].direction, network, loud)
    pose = jnp.zeros((8, 3))
    params = xa.BodyParams(pose, jnp.zeros(0), jnp.zeros(0), jnp.zeros(3), chain)

    def logit(joint):
        turned = eqx.tree_at(lambda p: p.pose, params, pose.at[joint].set(1.0))
        return network(x, network.condition(turned))

    assert logit(1) != logit(7)
    assert logit(7) == network(x, network.condition(params))


def test_nets_that_agree_close_the_cycle(rng):
    """Equal weights there and back: only the other terms are left, summed with their weights."""
    config = replace(scanimate_quick(), cycle=Stage(10, 1.0, 2, 6, 1e-3))
    weights = (rng.dirichlet(np.ones(3)) + 1e-4) / (1 + 3e-4)
    known = (weights * (1 + 3e-4) - 1e-4).astype(np.float32)
    corners = 0.3 * rng.standard_normal((2, 5, 3, 3))
    scans = Scans(
        jnp.asarray(corners, jnp.float32),
        jnp.broadcast_to(jnp.asarray(known), (2, 5, 3, 3)),
        jnp.asarray(random_transforms(rng, 2), jnp.float32),
        toy_params(2),
    )
    inverse = InverseSkinning(TREE, SMALL, frames=2, latent=4, known=True, key=jax.random.key(0))
    nets = SkinNets(Constant(jnp.asarray(weights, jnp.float32)), inverse)
    template = Template(jnp.zeros((4, 3)), jnp.broadcast_to(jnp.asarray(known), (4, 3)))
    for progress, raised in ((0.2, 1), (0.6, 10), (0.8, 100)):
        total, terms = skin_objective(
            nets, scans, template, config, jnp.asarray(progress), jax.random.key(1), cycle=True
        )
        assert terms["cycle"] < 1e-6
        assert terms["agreement"] < 1e-12
        assert terms["edge"] == 0
        by_name = vars(config.skin_weights)
        expected = sum(by_name[n] * float(v) for n, v in terms.items())
        expected += (raised - 1) * by_name["cycle"] * float(terms["cycle"])
        np.testing.assert_allclose(total, expected, rtol=1e-5)
    other = eqx.tree_at(lambda n: n.forward.weights, nets, jnp.asarray([1.0, 0.0, 0.0]))
    _, terms = skin_objective(
        other, scans, template, config, jnp.asarray(0.0), jax.random.key(1), cycle=True
    )
    assert terms["cycle"] > 1e-3


@pytest.mark.parametrize("derivatives", [False, True])
def test_the_right_distance_has_no_loss(rng, derivatives):
    """Small triangles of a sphere, and its own distance."""
    weights = ShapeWeights(normal=1.0, eikonal=1.0, offset=0.0) if derivatives else ShapeWeights()
    config = replace(scanimate_quick(), shape=Stage(1, 1.0, 2, 64, 1e-3), shape_weights=weights)
    centre = rng.standard_normal((2, 50, 3))
    across = np.cross(centre, rng.standard_normal((2, 50, 3)))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    along = np.cross(centre / np.linalg.norm(centre, axis=-1, keepdims=True), across)
    corners = centre[..., None, :] / np.linalg.norm(centre, axis=-1)[..., None, None]
    corners = corners + 0.004 * np.stack([0 * across, across, along], -2)
    corners *= 0.5 / np.linalg.norm(corners, axis=-1, keepdims=True)
    scans = CanonicalScans(jnp.asarray(corners, jnp.float32), toy_params(2))
    template = Template(jnp.asarray(corners[0, :, 0], jnp.float32), jnp.zeros((50, 3)))
    _, terms = shape_objective(Ball(), scans, template, config, jax.random.key(0))
    assert terms["surface"] < 2e-5
    assert terms["faces"] == 0
    assert terms["empty"] < 0.2
    if derivatives:
        assert terms["normal"] < 5e-3
        assert terms["eikonal"] < 1e-6
    else:
        assert terms["offset"] < 2e-5


def test_rates_fall_with_the_share_of_the_stage():
    steps, cosine = (Stage(8, 1.0, 1, 1, 0.1, s) for s in ("steps", "cosine"))
    done = [0.0, 0.49, 0.5, 0.74, 0.75, 1.0]
    found = [float(learning_rate(steps, jnp.asarray(d))) for d in done]
    np.testing.assert_allclose(found, [0.1, 0.1, 0.01, 0.01, 0.001, 0.001], rtol=1e-6)
    found = [float(learning_rate(cosine, jnp.asarray(d))) for d in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(found, [0.1, 0.0505, 0.001], rtol=1e-5)


def test_stretch_is_that_of_the_worst_edge():
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    scaled = triangle * [3.0, 1, 1]
    np.testing.assert_allclose(edge_stretch(triangle, scaled), 3, rtol=1e-6)
    np.testing.assert_allclose(edge_stretch(scaled, triangle), 3, rtol=1e-6)
    np.testing.assert_allclose(edge_stretch(triangle, triangle + 5), 1, rtol=1e-6)


def test_touching_parts_keep_their_own_weights(family):
    """Two plates a millimetre apart that face each other: the nearer one faces the other way."""
    body = family["smpl"]
    x, y = np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 1, 4), indexing="ij")
    plate = np.stack([x.ravel(), y.ravel(), np.zeros(16)], 1)
    cells = np.array([[k, k + 4, k + 1] for k in range(11) if k % 4 < 3])
    cells = np.concatenate([cells, [[k + 4, k + 5, k + 1] for k in range(11) if k % 4 < 3]])
    vertices = np.concatenate([plate, plate + np.array([0, 0, 0.001])])
    # The lower plate faces upwards, the upper one downwards.
    faces = np.concatenate([cells, cells[:, ::-1] + 16]).astype(np.int32)
    weights = np.zeros((32, 3))
    weights[:16, 0] = weights[16:, 1] = 1
    touching = replace(
        body, template=jnp.asarray(vertices), faces=faces, weights=jnp.asarray(weights)
    )
    points = np.array([[0.4, 0.4, 0.0008], [0.4, 0.4, 0.0002]])
    up = np.tile([0.0, 0, 1], (2, 1))
    np.testing.assert_array_equal(nearest_weights(touching, vertices, points, up)[:, 0], 1)
    np.testing.assert_array_equal(nearest_weights(touching, vertices, points, -up)[:, 1], 1)


def test_static_hands_have_the_mean_pose_of_the_frames(family, rng):
    body = family["smplx"]
    pose = np.zeros((3, 55, 3))
    pose[:, 25:] = 0.3 * rng.standard_normal((3, 30, 3))
    pose[:, 4] = 1.0  # a knee is not part of a hand
    params = xa.BodyParams.create(body, pose=pose)
    found = static_hands(body, params, np.zeros(10))
    assert found is not None
    mean = np.array(canonical_pose(body))
    mean[25:] = pose[:, 25:].mean(0)
    vertices = np.asarray(pose_body(body, xa.BodyParams.create(body, pose=mean)).vertices)
    weights = np.asarray(body.weights)
    on_hand = weights[:, [20, 21, *range(25, 55)]].sum(1)[body.faces].mean(1) > 0.5
    np.testing.assert_allclose(found[0], vertices[body.faces[on_hand]], atol=TOLERANCE["body_m"])
    np.testing.assert_allclose(found[1].sum(), 1)
