"""Signed distances against a sphere's, plans and seeds, and points on the skeleton."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import PARENTS, TREES

from xavatar_jax.body import BodyParams, Part, Parts
from xavatar_jax.frames import Frame
from xavatar_jax.sampling import (
    SamplingPlan,
    bone_points,
    joint_targets,
    pose_distance,
    signed_distance,
    surface_points,
    varied_frames,
    volume_points,
)


def sphere(radius, centre=(0.0, 0.0, 0.0), subdivisions=4):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)


def joined(*pieces):
    vertices, faces, count = [], [], 0
    for v, f in pieces:
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def points_at(radii, rng):
    direction = rng.normal(size=(len(radii), 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.asarray(radii)[:, None]


SAG = 3e-4  # metres: how far a triangle of the finest sphere of radius 0.1 lies below it


def test_distance_to_a_sphere(rng):
    radii = rng.uniform(0, 0.3, 500)
    radii[:3] = [0.0, 0.0999, 0.11]
    found = signed_distance(*sphere(0.1), points_at(radii, rng))
    np.testing.assert_allclose(found, 0.1 - radii, atol=SAG)


def test_a_sphere_inside_the_solid_is_no_surface(rng):
    """An eyeball inside the head: its surface is neither a boundary nor near one."""
    vertices, faces = joined(sphere(0.1), sphere(0.05))
    radii = np.concatenate([rng.uniform(0, 0.09, 300), rng.uniform(0.092, 0.12, 100)])
    found = signed_distance(vertices, faces, points_at(radii, rng), near=0.02)
    expected = 0.1 - radii
    assert (found[radii < 0.09] > 0).all()
    near_inner = np.abs(radii - 0.05) < 0.018
    np.testing.assert_allclose(found[near_inner], 0.02)  # "inside, and not near the surface"
    outer = radii > 0.085
    np.testing.assert_allclose(found[outer], expected[outer], atol=SAG)


def test_a_cavity_is_a_surface(rng):
    """The inner sphere turned inside out is a hole in the solid."""
    inner = sphere(0.05)
    vertices, faces = joined(sphere(0.1), (inner[0], inner[1][:, ::-1]))
    radii = rng.uniform(0, 0.12, 300)
    found = signed_distance(vertices, faces, points_at(radii, rng))
    expected = np.minimum(0.1 - radii, radii - 0.05)
    np.testing.assert_allclose(found, expected, atol=SAG)


def test_overlapping_pieces_are_one_solid(rng):
    """Where two spheres overlap, the buried parts of both are no surface."""
    vertices, faces = joined(sphere(0.1), sphere(0.1, (0.12, 0, 0)))
    points = rng.uniform([-0.15, -0.15, -0.15], [0.27, 0.15, 0.15], (2000, 3))
    union = np.maximum(
        0.1 - np.linalg.norm(points, axis=1), 0.1 - np.linalg.norm(points - [0.12, 0, 0], axis=1)
    )
    found = signed_distance(vertices, faces, points)
    outside = union < -SAG
    np.testing.assert_allclose(found[outside], union[outside], atol=SAG)
    np.testing.assert_array_equal(found[np.abs(union) > SAG] > 0, union[np.abs(union) > SAG] > 0)


def test_an_open_mesh_has_an_inside(rng):
    """A hole at the top: away from it, signs are those of the closed sphere."""
    vertices, faces = sphere(0.1)
    faces = faces[vertices[faces].mean(1)[:, 2] < 0.095]
    assert len(faces) < len(sphere(0.1)[1])
    radii = rng.uniform(0, 0.2, 500)
    points = points_at(radii, rng)
    clear = (points[:, 2] < 0.06) & (np.abs(radii - 0.1) > 2 * SAG)
    found = signed_distance(vertices, faces, points)
    np.testing.assert_array_equal(found[clear] > 0, radii[clear] < 0.1)


@pytest.fixture(scope="module")
def frame():
    """Four spheres: a body, a face and two hands; labels by vertex."""
    pieces = [
        sphere(0.3, subdivisions=3),
        sphere(0.1, (0, 0.5, 0), 3),
        sphere(0.05, (0.6, 0, 0), 2),
        sphere(0.05, (-0.6, 0, 0), 2),
    ]
    vertices, faces = joined(*pieces)
    labels = np.repeat([0, 1, 2, 3], [len(v) for v, _ in pieces])
    face = labels == 1
    labels[face & (vertices[:, 2] > 0.05)] = 4
    params = BodyParams(jnp.zeros((1, 3)), jnp.zeros(1), jnp.zeros(0), jnp.zeros(3), TREES["mano"])
    toy = Frame(vertices.astype(np.float32), faces.astype(np.int32), params, None, "toy")
    return toy, Parts(labels.astype(np.int8))


PLAN = SamplingPlan(
    body=200, face=80, eyes_mouth=40, hand=60, box=50, sigma=(0.0,), fine_sigma=(0.0,)
)


@pytest.mark.parametrize("by_vertex", [True, False])
def test_counts_by_part_and_places(frame, by_vertex):
    plan = replace(PLAN, by_vertex=by_vertex)
    assert plan.total == 200 + 80 + 40 + 2 * 60 + 50
    found = volume_points(*frame, plan, np.random.default_rng(0))
    assert found.x_d.shape == (plan.total, 3)
    assert found.x_d.dtype == np.float32
    counts = np.bincount(found.part, minlength=5)
    np.testing.assert_array_equal(counts, [250, 80, 60, 60, 40])
    for part, centre, radius in ((2, (0.6, 0, 0), 0.05), (3, (-0.6, 0, 0), 0.05)):
        away = np.linalg.norm(found.x_d[found.part == part] - centre, axis=1)
        np.testing.assert_allclose(away, radius, atol=3e-3)
        assert np.abs(found.distance[found.part == part]).max() < 1e-5
    low, high = frame[0].vertices.min(0) - 0.1, frame[0].vertices.max(0) + 0.1
    box = found.x_d[-50:]
    assert ((box >= low) & (box <= high)).all()
    assert np.ptp(box, axis=0).min() > 0.5 * (high - low).min()


def test_every_vertex_of_a_part_has_the_same_odds(frame):
    plan = replace(PLAN, body=0, face=0, eyes_mouth=0, hand=16_200, box=0)
    found = volume_points(*frame, plan, np.random.default_rng(3))
    toy, parts = frame
    for part in (2, 3):
        own = toy.vertices[parts.labels == part]
        drawn = found.x_d[found.part == part]
        apart = np.abs(drawn[:, None] - own).max(2)
        assert apart.min(1).max() < 1e-6
        times = np.bincount(apart.argmin(1), minlength=len(own))
        assert len(own) == 162
        # A hundred draws a vertex: five standard deviations of such a count.
        assert np.abs(times - 100).max() < 50


def test_noise_has_the_sizes_given(frame):
    plan = SamplingPlan(
        body=4000, face=0, eyes_mouth=0, hand=0, sigma=(0.002, 0.03), by_vertex=False
    )
    found = volume_points(*frame, plan, np.random.default_rng(1))
    off = np.abs(np.linalg.norm(found.x_d, axis=1) - 0.3)
    # Along the normal of a sphere the offset is a normal deviate: mean size 0.8 sigma.
    np.testing.assert_allclose(off[::2].mean(), 0.8 * 0.002, atol=1e-3)
    np.testing.assert_allclose(off[1::2].mean(), 0.8 * 0.03, rtol=0.1)
    expected = 0.3 - np.linalg.norm(found.x_d, axis=1)
    alone = np.abs(found.x_d).max(1) < 0.32  # nearer to this sphere than to the others
    np.testing.assert_allclose(found.distance[alone], expected[alone], atol=4e-3)


def test_the_whole_surface_without_parts(frame):
    plan = replace(PLAN, uniform=True, by_vertex=False, box=0)
    found = volume_points(*frame, plan, np.random.default_rng(2))
    assert len(found.x_d) == plan.total
    areas = np.array([0.3, 0.1, 0.05, 0.05]) ** 2
    share = np.bincount(np.where(found.part == 4, 1, found.part), minlength=4) / plan.total
    np.testing.assert_allclose(share, areas / areas.sum(), atol=0.05)


def test_a_missing_part_gives_its_points_to_the_body(frame):
    toy, parts = frame
    without = parts.with_labels(np.where(parts.labels == 2, 0, parts.labels))
    found = volume_points(toy, without, PLAN, np.random.default_rng(0))
    counts = np.bincount(found.part, minlength=5)
    np.testing.assert_array_equal(counts, [310, 80, 0, 60, 40])


def test_seeds(frame):
    plan = replace(PLAN, sigma=(0.01,))
    a, b, c = (volume_points(*frame, plan, np.random.default_rng(s)) for s in (5, 5, 6))
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)
    assert not np.array_equal(a.x_d, c.x_d)


def test_parts_of_a_body_decide_what_is_drawn(frame):
    """Two hands that are one part of their own, sampled as a hand and with the fine noise."""
    toy, parts = frame
    table = (Part("body"), Part("claw", region="hands", sampled_as="hand"))
    claws = Parts(np.isin(parts.labels, (2, 3)).astype(np.int8), table)
    plan = replace(PLAN, sigma=(0.1,), box=0)
    found = volume_points(toy, claws, plan, np.random.default_rng(0))
    np.testing.assert_array_equal(np.bincount(found.part), [200, 60])
    assert np.abs(found.distance[found.part == 1]).max() < 1e-5
    assert np.abs(found.distance[found.part == 0]).mean() > 0.02


def test_surface_points_of_a_sphere(rng):
    """Positions, normals and colours against the sphere's; weights sum to areas."""
    vertices, faces = sphere(0.3)
    labels = np.where(vertices[:, 2] > 0, 1, 0)
    parts = Parts(labels.astype(np.int8))
    ramp = np.repeat(((vertices[:, :1] + 0.3) / 0.6), 3, axis=1)
    shades = np.concatenate([np.rint(255 * ramp), np.zeros((len(vertices), 1))], 1)
    for densities in (None, parts.densities):
        found = surface_points(
            vertices, faces, parts, 20_000, rng, colors=shades.astype(np.uint8),
            densities=densities,
        )  # fmt: skip
        out = found.x_d / np.linalg.norm(found.x_d, axis=1, keepdims=True)
        np.testing.assert_allclose(np.linalg.norm(found.x_d, axis=1), 0.3, atol=1e-3)
        np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-5)
        assert (found.normal * out).sum(1).min() > 0.99
        np.testing.assert_allclose(found.color[:, 0], (found.x_d[:, 0] + 0.3) / 0.6, atol=3e-3)
        assert found.color.shape == (20_000, 3)
        far = np.abs(found.x_d[:, 2]) > 0.05
        np.testing.assert_array_equal(found.part[far], (found.x_d[:, 2] > 0)[far])
        area = 4 * np.pi * 0.3**2
        np.testing.assert_allclose(found.weight.sum(), area, rtol=0.03)
        np.testing.assert_allclose(found.weight[found.part == 1].sum(), area / 2, rtol=0.05)
        share = (found.part == 1).mean()
        np.testing.assert_allclose(share, 0.5 if densities is None else 5 / 6, atol=0.03)
    plain = surface_points(vertices, faces, parts, 10, rng)
    assert plain.color is None
    assert {leaf.dtype for leaf in (plain.x_d, plain.normal, plain.weight)} == {
        np.dtype(np.float32)
    }
    with pytest.raises(ValueError, match="3 colors for"):
        surface_points(vertices, faces, parts, 10, rng, colors=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="without area"):
        surface_points(np.zeros((3, 3)), np.array([[0, 1, 2]]), Parts(np.zeros(3, np.int8)), 5, rng)


def test_varied_frames_pick_the_odd_ones_out(rng):
    """Ninety frames alike and three unlike: those three are chosen, whatever their place."""
    pose = 1e-3 * rng.normal(size=(93, 55, 3))
    odd = [17, 50, 92]
    pose[17, 16], pose[50, 5], pose[92, 30] = (0, 1, 0), (1.2, 0, 0), (0, 0, 1.5)
    params = BodyParams(
        jnp.asarray(pose), jnp.zeros((93, 1)), jnp.zeros((93, 2)), jnp.zeros((93, 3)),
        TREES["smplx"],
    )  # fmt: skip
    chosen = varied_frames(params, 4)
    assert set(odd) <= set(chosen)
    assert list(chosen) == sorted(chosen)
    np.testing.assert_array_equal(chosen, varied_frames(params, 4))
    np.testing.assert_array_equal(varied_frames(params, 200), np.arange(93))
    # Where a person stands and faces tells nothing about their shape.
    turned = replace(params, pose=params.pose.at[40, 0].set(jnp.array([0.0, 3.0, 0.0])))
    np.testing.assert_array_equal(varied_frames(turned, 4), chosen)
    smiling = replace(params, expression=params.expression.at[40].set(5.0))
    assert 40 in varied_frames(smiling, 4)


def test_frames_all_alike_are_chosen_once_each():
    params = BodyParams.zeros(SimpleNamespace(tree=TREES["smplx"], num_joints=55, num_betas=1,
                                              num_expression=1), (9,))  # fmt: skip
    assert len(set(varied_frames(params, 5))) == 5


def test_pose_distance_is_the_mean_square_angle_to_the_nearest_pose():
    """One joint apart by an angle, of the 54 that count; two apart by the same; the root alone."""
    angle = 0.6
    pose = np.zeros((3, 55, 3))
    pose[0, 17, 2] = angle
    pose[1, [17, 40], 0] = 0.2 + angle
    pose[2, 0] = [0, 2.0, 0]
    known = np.zeros((2, 55, 3))
    known[1, [17, 40], 0] = 0.2

    def params(values):
        count = len(values)
        zeros = [jnp.zeros((count, n)) for n in (1, 2, 3)]
        return BodyParams(jnp.asarray(values), *zeros, TREES["smplx"])

    expected = np.rad2deg([angle / np.sqrt(54), angle * np.sqrt(2 / 54), 0])
    np.testing.assert_allclose(pose_distance(params(pose), params(known)), expected, atol=0.02)
    other = BodyParams(jnp.zeros((1, 24, 3)), *(jnp.zeros((1, n)) for n in (1, 2, 3)),
                       TREES["smpl"])  # fmt: skip
    with pytest.raises(ValueError, match="24 joints"):
        pose_distance(other, params(known))


@pytest.mark.parametrize("kind", PARENTS)
def test_bone_points_lie_on_their_bones(kind, rng):
    tree = TREES[kind]
    joints = rng.normal(size=(tree.num_joints, 3))
    points = bone_points(tree, jnp.asarray(joints, jnp.float32), jax.random.key(0))
    points = np.asarray(points).reshape(tree.num_joints - 1, 5, 3)
    for row, (joint, parent) in enumerate(zip(range(1, tree.num_joints), PARENTS[kind][1:],
                                              strict=True)):  # fmt: skip
        along = joints[joint] - joints[parent]
        share = (points[row] - joints[parent]) @ along / (along @ along)
        assert ((share > -1e-5) & (share < 1 + 1e-5)).all()
        away = points[row] - joints[parent] - share[:, None] * along
        np.testing.assert_allclose(away, 0, atol=1e-5)
        assert np.ptp(share) > 0.3  # spread from end to end
    again = bone_points(tree, jnp.asarray(joints, jnp.float32), jax.random.key(1))
    assert not np.array_equal(np.asarray(again).reshape(points.shape), points)


def test_joint_targets_are_the_two_bones_that_meet():
    where, target = joint_targets(TREES["smplx"])
    assert where.shape == (109,)
    assert target.shape == (109, 55)
    np.testing.assert_array_equal(target.sum(1), 1)
    # The mean target at a joint: half its own bone, half its parent's.
    for joint in range(1, 55):
        mean = target[where == joint].mean(0)
        assert mean[joint] == 0.5
        assert mean[PARENTS["smplx"][joint]] == 0.5
    np.testing.assert_array_equal(target[where == 0], np.eye(55)[:1])
