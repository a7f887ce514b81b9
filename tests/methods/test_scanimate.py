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
from xavatar_jax.body import canonical_pose, pose_body
from xavatar_jax.fields import AbstractPlainGeometry, AbstractSkinningField, GeometryValue, MLPShape
from xavatar_jax.kinematics import KinematicTree
from xavatar_jax.methods.scanimate import ShapeWeights, SkinWeights, StagePlan, stages
from xavatar_jax.methods.scanimate.networks import (
    InverseSkinning,
    LocalPoseMLP,
    SoftmaxSkinning,
    adjacency,
    quaternions,
)
from xavatar_jax.methods.scanimate.scans import Scans, edge_stretch, nearest_weights, static_hands
from xavatar_jax.methods.scanimate.stages import (
    CanonicalScans,
    Shaped,
    Skinned,
    SkinNets,
    Template,
    shape_stage,
    skin_stage,
)

TREE = KinematicTree(("a", "b", "c"), (-1, 0, 1))
SMALL = MLPShape(width=16, depth=2, octaves=2, skip=(), condition_at=(0,), condition_embedding=8)


class Constant(AbstractSkinningField):
    """The same weights everywhere."""

    weights: jax.Array

    def __call__(self, x_c):
        return self.weights

    def covers(self, x_c):
        return jnp.asarray(True)


class Ball(AbstractPlainGeometry):
    """Its logit is the distance to the sphere of radius one half, positive inside, over 4 mm."""

    def condition(self, params):
        return params.transl

    def __call__(self, x_c, condition):
        return GeometryValue((0.5 - jnp.sqrt((x_c**2).sum() + 1e-12)) / 0.004)


def random_transforms(rng, count, joints=3):
    transforms = np.tile(np.eye(4), (count, joints, 1, 1))
    turns = Rotation.from_rotvec(0.5 * rng.standard_normal((count * joints, 3))).as_matrix()
    transforms[..., :3, :3] = turns.reshape(count, joints, 3, 3)
    transforms[..., :3, 3] = 0.1 * rng.standard_normal((count, joints, 3))
    return transforms


def toy_params(count):
    pose = jnp.zeros((count, 3, 3))
    return xa.BodyParams(pose, jnp.zeros((count, 0)), jnp.zeros((count, 0)), pose[:, 0], TREE)


def answers(kind, **values):
    """What the nets answered, where only some of it matters."""
    return kind(**{name: values.get(name) for name in kind._fields})


def test_terms_are_those_of_numpy(rng, x64):
    w, v = (rng.dirichlet(np.ones(5), (4, 3)) for _ in range(2))
    w[0, 0] = [1, 0, 0, 0, 0]
    x, y = rng.standard_normal((2, 7, 3))
    d, e = 0.03 * rng.standard_normal((2, 9))
    skinned = answers(
        Skinned, wanted=v[0], forward_at_body=w[0], inverse_at_body=w, known=v, inverse=w,
        forward=v, latent=x, corners=x, again=y,
    )  # fmt: skip
    shaped = answers(
        Shaped, inside=d, faces=d, value=d, beside=d, step=e, slope=x, slopes=x, normals=y
    )
    error = ((w - v) ** 2).mean()
    expected = {
        "body": ((w - v[0]) ** 2).mean() + ((w[0] - v[0]) ** 2).mean(),
        "scan": 0.0,
        "both_scan": error,
        "agreement": error,
        "sparsity": np.mean([[sum(abs(n) ** 0.8 for n in p) for p in row] for row in w]),
        "latent": np.linalg.norm(x, axis=1).mean(),
        "cycle": np.abs(x - y).mean(),
        "edge": np.mean(
            [np.abs(t[a] - t[b]).sum() for t in w for a, b in ((0, 1), (1, 2), (2, 0))]
        ),
        "surface": np.abs(d).mean(),
        "normal": np.linalg.norm(x - y, axis=1).mean(),
        "eikonal": ((np.linalg.norm(x, axis=1) - 1) ** 2).mean(),
        "empty": np.exp(-100 * np.abs(d)).mean(),
        "faces": np.where(d < 0, -d, 0).mean(),
        "offset": np.abs(d - e).mean(),
    }
    given = dict.fromkeys(expected, shaped)
    given |= dict.fromkeys(list(expected)[:8], skinned)
    for name, value in expected.items():
        out = jax.tree.map(jnp.asarray, given[name])
        found = getattr(stages, f"{name}_term")(None, out, None)
        # A weight of zero counts as 1e-6, to the power of 0.8.
        atol = 1e-5 if name == "sparsity" else 1e-12
        np.testing.assert_allclose(found, value, atol=atol, err_msg=name)


@pytest.mark.parametrize("name", ["sparsity", "latent", "normal", "eikonal"])
def test_terms_have_finite_slopes_at_zero(name):
    zeros = jnp.zeros((2, 3))

    def term(x):
        kind, values = {
            "sparsity": (Skinned, {"inverse": x}),
            "latent": (Skinned, {"latent": x}),
            "normal": (Shaped, {"slope": x, "normals": zeros}),
            "eikonal": (Shaped, {"slopes": x}),
        }[name]
        return getattr(stages, f"{name}_term")(None, answers(kind, **values), None)

    assert jnp.isfinite(jax.grad(term)(zeros)).all()


def terms_of(stage, model, data, key):
    """The value of each term of a stage."""
    draw_key, forward_key = jax.random.split(key)
    out = stage.forward(model, stage.draw(model, data, draw_key), forward_key)
    return {name: float(term(model, out, key)) for name, (_, term) in stage.terms.items()}


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
    stage = skin_stage(
        StagePlan(10, 1.0, 2, 6, 1e-3), SkinWeights(), cycle=True, learn_forward=True, clip=1.0,
        epsilon=1e-8,
    )  # fmt: skip
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
    terms = terms_of(stage, nets, (scans, template), jax.random.key(1))
    assert terms["cycle"] < 1e-6
    assert terms["agreement"] < 1e-12
    assert terms["edge"] == 0
    weights = {name: weight for name, (weight, _) in stage.terms.items()}
    rising = weights.pop("cycle")
    assert weights == {name: getattr(SkinWeights(), name) for name in weights}
    for done, raised in ((0.2, 1), (0.6, 10), (0.8, 100)):
        assert float(rising(jnp.asarray(done))) == pytest.approx(0.1 * raised, rel=1e-5)
    other = eqx.tree_at(lambda n: n.forward.weights, nets, jnp.asarray([1.0, 0.0, 0.0]))
    terms = terms_of(stage, other, (scans, template), jax.random.key(1))
    assert terms["cycle"] > 1e-3


@pytest.mark.parametrize("derivatives", [False, True])
def test_the_right_distance_has_no_loss(rng, derivatives):
    """Small triangles of a sphere, and its own distance."""
    weights = ShapeWeights(normal=1.0, eikonal=1.0, offset=0.0) if derivatives else ShapeWeights()
    stage = shape_stage(
        StagePlan(1, 1.0, 2, 64, 1e-3), weights, softness=0.004, clip=1.0, epsilon=1e-8
    )
    centre = rng.standard_normal((2, 50, 3))
    across = np.cross(centre, rng.standard_normal((2, 50, 3)))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    along = np.cross(centre / np.linalg.norm(centre, axis=-1, keepdims=True), across)
    corners = centre[..., None, :] / np.linalg.norm(centre, axis=-1)[..., None, None]
    corners = corners + 0.004 * np.stack([0 * across, across, along], -2)
    corners *= 0.5 / np.linalg.norm(corners, axis=-1, keepdims=True)
    scans = CanonicalScans(jnp.asarray(corners, jnp.float32), toy_params(2))
    template = Template(jnp.asarray(corners[0, :, 0], jnp.float32), jnp.zeros((50, 3)))
    terms = terms_of(stage, Ball(), (scans, template), jax.random.key(0))
    assert terms["surface"] < 2e-5
    assert terms["faces"] == 0
    assert terms["empty"] < 0.2
    if derivatives:
        assert terms["normal"] < 5e-3
        assert terms["eikonal"] < 1e-6
    else:
        assert terms["offset"] < 2e-5


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
