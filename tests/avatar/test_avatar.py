"""The avatar as a user meets it: meshes, occupancy, evaluation."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import xavatar_jax as xa
from xavatar_jax.avatar import CellSizes
from xavatar_jax.body import SMPL_TREE, canonical_vertices
from xavatar_jax.fields import grid_vertices
from xavatar_jax.geometry import closest_points, winding_number
from xavatar_jax.meshing import EmptyLevelSetError


def test_fit_learns_the_person(run):
    """Held-out surfaces are met within what 120 steps on coarse grids can give."""
    after = xa.evaluate(run.fit.avatar, run.test, num_frames=2, verbose=False).mean
    before = xa.evaluate(run.fit.before, run.test, num_frames=1, verbose=False).mean
    assert after.cd_mm.all < 1.5
    assert after.cd_mm.hands < 1.5
    assert after.iou.all > 0.95
    assert after.cd_mm.all < 0.5 * before.cd_mm.all
    assert after.cd_mm.hands < 0.5 * before.cd_mm.hands
    assert after.cd_mm.face < 0.8 * before.cd_mm.face


def test_the_start_is_the_mean_shape(run):
    """Before anything is learned the surface is that of no betas, not the person's."""
    mesh = run.fit.before.canonical_mesh()
    mean, own = (
        np.median(closest_points(mesh.vertices, mesh.faces, grid_vertices(run.body, betas))[0])
        for betas in (None, run.fit.avatar.betas)
    )
    assert mean < 0.003
    assert own > 2 * mean


def test_the_range_heard_is_that_of_the_frames_learned_from(run):
    geometry = run.fit.avatar.model.geometry
    pose = np.asarray(run.fit.frames.params.pose)
    turned = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix() - np.eye(3)
    turned = turned.reshape(*pose.shape[:2], 9)
    turned[:, 0] = 0
    expected = np.stack([turned.min(0).clip(max=0), turned.max(0).clip(min=0)])
    np.testing.assert_allclose(geometry.pose_range, expected, atol=1e-6)
    assert not np.asarray(geometry.expression_range).any()


def test_a_face_smiles_as_the_body_does_although_no_frame_did(run):
    neutral = replace(run.test[0].params, expression=jnp.zeros(10))
    smile = replace(neutral, expression=jnp.asarray([2.0, *9 * [0.0]]))
    before, after = (np.asarray(xa.pose_body(run.body, p).vertices) for p in (neutral, smile))
    moved = np.linalg.norm(after - before, axis=1) > 0.005
    assert moved.sum() > 20
    still, smiling = (run.fit.avatar.mesh(p) for p in (neutral, smile))
    away = [
        np.median(closest_points(mesh.vertices, mesh.faces, after[moved])[0])
        for mesh in (still, smiling)
    ]
    assert away[1] < 0.5 * away[0]


def test_quiet_fit_prints_nothing(run, capsys):
    xa.evaluate(run.fit.avatar, run.test, num_frames=1, verbose=False)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == ""


def test_history_has_every_term(run):
    history = run.fit.history
    assert history.steps_done == run.config.steps
    assert {"loss", "occupancy", "bone", "skinning_surface", "skinning_joint"} <= set(history.terms)
    assert history.terms["occupancy"][-1] < history.terms["occupancy"][0]
    assert {"prefit", "weights", "labels", "roots", "compile", "train", "total"} <= set(
        history.seconds
    )


def test_mesh_is_closed_and_follows_translation(run):
    frame = run.test[0]
    mesh = run.fit.avatar.mesh(frame.params)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert mesh.num_vertices <= 50_000
    assert np.abs(mesh.vertices.mean(0) - frame.vertices.mean(0)).max() < 0.05


def test_all_poses_share_faces(run):
    avatar = run.fit.avatar
    first, second = (avatar.mesh(run.test[k].params) for k in (0, 1))
    assert np.array_equal(first.faces, second.faces)


def test_max_vertices_is_kept(run):
    mesh = run.fit.avatar.canonical_mesh(max_vertices=5000)
    assert mesh.num_vertices <= 5000


def test_full_mode_agrees_with_fast_mode(run):
    """Extraction of the posed field and skinning of the canonical surface meet."""
    params = run.test[0].params
    coarse = CellSizes(body=0.03, head=0.02, face=0.02, hands=0.01)
    full = run.fit.avatar.mesh(params, mode="full", cell=coarse)
    fast = run.fit.avatar.mesh(params)
    distance, _, _ = closest_points(fast.vertices, fast.faces, full.vertices)
    # Chords of coarse cells lie inside the surface by about cell^2 / (8 radius).
    assert np.median(distance) < 0.003
    assert np.quantile(distance, 0.95) < 0.012


def test_occupancy_knows_inside_from_outside(run):
    frame = run.test[0]
    rng = np.random.default_rng(0)
    rows = rng.choice(len(frame.vertices), 256)
    points = frame.vertices[rows] + 0.02 * rng.standard_normal((256, 3)).astype(np.float32)
    distance, _, _ = closest_points(frame.vertices, frame.faces, points)
    clear = distance > 0.004
    inside = winding_number(frame.vertices, frame.faces, points) > 0.5
    value = np.asarray(run.fit.avatar.occupancy(jnp.asarray(points), frame.params))
    assert ((value >= 0) & (value <= 1)).all()
    assert ((value > 0.5) == inside)[clear].mean() > 0.99


def test_far_points_are_outside(run):
    far = jnp.asarray([[10.0, 0.0, 0.0], [0.0, -30.0, 2.0]])
    assert np.array_equal(run.fit.avatar.occupancy(far, run.test[0].params), [0.0, 0.0])


def test_nothing_changes_far_from_the_origin(run):
    """In a camera's space a person may stand anywhere; what float32 loses there is the points'."""
    avatar, frame = run.fit.avatar, run.test[0]
    points = jnp.asarray(frame.vertices[::400])
    far = jnp.asarray([0.0, 0.0, 256.0])
    moved = replace(frame.params, transl=frame.params.transl + far)
    here, there = avatar.query(points, frame.params), avatar.query(points + far, moved)
    assert np.asarray(there.found).all()
    assert np.abs(np.asarray(here.x_c - there.x_c)).max() < 2e-4
    by_point = jax.jacrev(lambda x: avatar.query(x, frame.params).level.sum())(points)

    def shifted(transl):
        return avatar.query(points, replace(frame.params, transl=transl)).level.sum()

    by_transl = jax.grad(shifted)(frame.params.transl)
    np.testing.assert_allclose(by_transl, -by_point.sum(0), rtol=1e-3, atol=1e-2)


def test_occupancy_is_differentiable_in_points_and_pose(run):
    """Against central differences of the posed field itself, searched anew at each point."""
    avatar, frame = run.fit.avatar, run.test[1]
    labels = np.asarray(run.body.part_labels)
    rows = np.flatnonzero(labels == 0)[::900][:8]
    points = jnp.asarray(frame.vertices[rows])

    def logits(x, pose):
        params = xa.BodyParams.create(
            run.body,
            pose=pose,
            betas=frame.params.betas,
            expression=frame.params.expression,
            transl=frame.params.transl,
        )
        return avatar.query(x, params).level

    pose = frame.params.pose
    by_point, by_pose = jax.jacrev(logits, argnums=(0, 1))(points, pose)
    gradient = jnp.einsum("nna->na", by_point)
    assert not (by_point - jnp.einsum("na,nm->nma", gradient, jnp.eye(8))).any()
    step = 2e-4
    for axis in range(3):
        moved = jnp.zeros(3).at[axis].set(step)
        numeric = (logits(points + moved, pose) - logits(points - moved, pose)) / (2 * step)
        scale = np.linalg.norm(gradient, axis=1).max()
        # Feature grids are linear between nodes: differences may straddle a kink.
        assert np.median(np.abs(numeric - gradient[:, axis])) < 0.03 * scale
    assert np.isfinite(by_pose).all()
    spine = run.body.tree.index("spine3")
    # A turn that moves the farthest point by a tenth of a millimetre: within a cell for most.
    turn = jnp.zeros_like(pose).at[spine, 2].set(1.5e-4)
    numeric = (logits(points, pose + turn) - logits(points, pose - turn)) / 3e-4
    analytic = by_pose[:, spine, 2]
    scale = np.abs(analytic).max()
    assert scale > 10
    assert np.median(np.abs(numeric - analytic)) < 0.03 * scale


def test_skin_weights_are_those_of_the_template_on_the_surface(run):
    avatar = run.fit.avatar
    vertices = np.asarray(canonical_vertices(run.body, jnp.asarray(avatar.betas)))
    weights = np.asarray(avatar.skin_weights(jnp.asarray(vertices)))
    assert np.abs(weights.sum(1) - 1).max() < 1e-5
    assert weights.min() >= 0
    assert np.median(np.abs(weights - np.asarray(run.body.weights)).max(1)) < 0.05


def test_unknown_mode_is_named(run):
    with pytest.raises(ValueError, match="unknown mode 'quick'"):
        run.fit.avatar.mesh(run.test[0].params, mode="quick")


def test_nan_parameters_are_named(run):
    params = xa.BodyParams.create(run.body, pose=np.full((55, 3), np.nan))
    with pytest.raises(ValueError, match=r"params\.pose"):
        run.fit.avatar.mesh(params)


def test_parameters_of_another_tree_are_refused(run):
    other = xa.BodyParams(
        pose=jnp.zeros((24, 3)),
        betas=jnp.zeros(10),
        expression=jnp.zeros(0),
        transl=jnp.zeros(3),
        tree=SMPL_TREE,
    )
    with pytest.raises(ValueError, match="24 joints"):
        run.fit.avatar.mesh(other)


def test_a_field_without_surface_is_an_error(run):
    model = run.fit.avatar.model
    empty = eqx.tree_at(lambda m: m.geometry.biases[2], model, jnp.full(1, -1000.0))
    avatar = replace(run.fit.avatar, model=empty)
    with pytest.raises(EmptyLevelSetError):
        avatar.canonical_mesh()
