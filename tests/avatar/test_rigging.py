"""A rigged avatar: its file, read and skinned in NumPy, against the library's own skinning."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from gltf.reader import GltfFile
from gltf.tools import blender_vertices, three_vertices, validation_report
from scipy.spatial.transform import Rotation

import xavatar_jax as xa
from xavatar_jax.avatar import rigging

FPS = 30.0
# A tenth of a millimetre is what a rigged file promises.
AGREES = 1e-4


@pytest.fixture(scope="module")
def motion(run) -> xa.Motion:
    rng = np.random.default_rng(3)
    pose = np.cumsum(np.deg2rad(6) * rng.standard_normal((8, 55, 3)), axis=0)
    params = xa.BodyParams.create(
        run.body,
        pose=pose,
        betas=run.fit.avatar.betas,
        expression=1.5 * rng.standard_normal((8, 10)),
        transl=np.cumsum(0.1 * rng.standard_normal((8, 3)), axis=0),
    )
    return xa.Motion.from_params(params, fps=FPS, source="folder/reach.npz")


@pytest.fixture(scope="module")
def file(run, motion, tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "avatar.glb"
    report = run.fit.avatar.export_glb(path, motion, verbose=False)
    return GltfFile(path), report


def skinned(run, motion: xa.Motion, frame: int, file: GltfFile) -> np.ndarray:
    """The library's own forward skinning of what the file holds."""
    params = motion.to_params(run.body)[frame]
    channels = file.json["animations"][0]["channels"]
    (number,) = [c["sampler"] for c in channels if c["target"]["path"] == "weights"]
    output = file.accessor(file.json["animations"][0]["samplers"][number]["output"])
    shape = output.reshape(len(motion), -1)[frame]
    points = file.attribute("POSITION") + np.tensordot(shape, file.targets(), 1)
    moves = xa.bone_transforms(run.body, params)
    weights = jnp.asarray(file.weights(), jnp.float32)
    return np.asarray(xa.skin_points(jnp.asarray(points, jnp.float32), weights, moves))


def test_file_moves_as_the_library_does(run, motion, file):
    for frame in (0, 3, 7):
        expected = skinned(run, motion, frame, file[0])
        assert np.abs(file[0].posed(frame / FPS) - expected).max() < AGREES


def test_three_js_and_blender_move_as_the_library_does(run, motion, file):
    frames = [0, 3, 7]
    for read in (three_vertices, blender_vertices):
        found, _ = read(file[1].path, FPS, frames)
        for k, frame in enumerate(frames):
            assert np.abs(found[k] - skinned(run, motion, frame, file[0])).max() < AGREES


def test_the_khronos_validator_finds_nothing(file):
    issues = validation_report(file[1].path)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_blend_shapes_are_the_fields_own_expressions(run, file):
    """Of the exact neutral surfaces under one coefficient, at what the weight of one stands for."""
    avatar, glb = run.fit.avatar, file[0]
    names = glb.mesh["extras"]["targetNames"]
    assert names == [f"expression_{k}_{s}" for s in ("plus", "minus") for k in range(10)]
    neutral = xa.canonical_params(run.body, jnp.asarray(avatar.betas))
    rest = avatar.canonical_mesh(neutral).vertices
    np.testing.assert_allclose(glb.attribute("POSITION"), rest, atol=1e-6)
    scales = file[1].expression_scales
    for name, sign in (("expression_2_plus", 1.0), ("expression_2_minus", -1.0)):
        expression = jnp.zeros(10).at[2].set(sign)
        params = xa.BodyParams.create(
            run.body, pose=neutral.pose, betas=avatar.betas, expression=expression
        )
        exact = avatar.canonical_mesh(params).vertices - rest
        found = glb.targets()[names.index(name)] / scales[2]
        moved = np.linalg.norm(exact, axis=1)
        assert np.linalg.norm(found - exact, axis=1).mean() < 0.3 * moved.mean() + 1e-6


def test_coefficients_become_weights_between_zero_and_one(motion, file):
    glb, report = file
    channels = glb.json["animations"][0]["channels"]
    (number,) = [c["sampler"] for c in channels if c["target"]["path"] == "weights"]
    weights = glb.accessor(glb.json["animations"][0]["samplers"][number]["output"])
    weights = weights.reshape(len(motion), 20)
    assert weights.min() == 0
    assert weights.max() <= 1
    coefficients = (weights[:, :10] - weights[:, 10:]) * report.expression_scales
    np.testing.assert_allclose(coefficients, motion.expression, atol=1e-6)


def test_losses_are_those_of_the_file(run, motion, file):
    glb, report = file
    avatar = run.fit.avatar
    animation = avatar.animate(motion)
    every = np.asarray(avatar.rest.weights).T
    by_influence, in_all = [], []
    for k in range(len(motion)):
        four = skinned(run, motion, k, glb)
        in_all.append(np.linalg.norm(four - animation.frame_vertices(k), axis=1))
        lost = glb.weights() - every
        moves = np.asarray(xa.bone_transforms(run.body, motion.to_params(run.body)[k]))
        channel = next(c for c in glb.json["animations"][0]["channels"] if "weights" in str(c))
        output = glb.json["animations"][0]["samplers"][channel["sampler"]]["output"]
        shape = glb.accessor(output).reshape(len(motion), -1)[k]
        points = glb.attribute("POSITION") + np.tensordot(shape, glb.targets(), 1)
        change = np.einsum("vj,jab->vab", lost, moves)
        by_influence.append(
            np.linalg.norm(
                np.einsum("vab,vb->va", change[:, :3, :3], points) + change[:, :3, 3], axis=1
            )
        )
    assert report.checked == len(motion)
    assert report.influence_loss.mean == pytest.approx(1000 * np.mean(by_influence), rel=0.02)
    assert report.influence_loss.max == pytest.approx(1000 * np.max(by_influence), rel=0.02)
    assert report.total_loss.mean == pytest.approx(1000 * np.mean(in_all), rel=0.02)
    assert f"lose {report.influence_loss.mean:.3f} mm on average" in str(report)


def test_z_up_motions_stand_up(run, motion, file, tmp_path):
    """Turned in the file as `to_y_up` turns them."""
    turned = motion.to_z_up(run.body)
    assert turned.up == "z"
    report = run.fit.avatar.export_glb(tmp_path / "z.glb", turned, verbose=False)
    for frame in (0, 5):
        found = GltfFile(report.path).posed(frame / FPS)
        assert np.abs(found - file[0].posed(frame / FPS)).max() < AGREES


def test_double_precision_parameters_give_the_same_file(run, motion, file, tmp_path, x64):
    params = motion.to_params(run.body)
    assert params.pose.dtype == np.float64
    report = run.fit.avatar.export_glb(tmp_path / "a.glb", params, verbose=False)
    found = GltfFile(report.path).posed(5 / FPS)
    assert np.abs(found - file[0].posed(5 / FPS)).max() < AGREES


def test_several_clips_eight_influences_and_colors(run, motion, tmp_path):
    avatar = run.fit.avatar
    count = avatar.canonical_mesh().num_vertices
    report = avatar.export_glb(
        tmp_path / "a.glb",
        {"first": motion[:3], "second": motion.to_params(run.body)[3:]},
        influences=8,
        colors=np.full((count, 3), 200, np.uint8),
        verbose=False,
    )
    assert report.frames == {"first": 3, "second": 5}
    glb = GltfFile(report.path)
    assert {"COLOR_0", "JOINTS_1", "WEIGHTS_1"} <= set(glb.primitive["attributes"])
    issues = validation_report(report.path)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_a_file_without_motion_stands_in_canonical_pose(run, tmp_path, capsys):
    report = run.fit.avatar.export_glb(tmp_path / "a.glb", expressions=False)
    glb = GltfFile(report.path)
    assert report.influence_loss is None
    assert "55 joints, 0 blend shapes, clips: none" in capsys.readouterr().out
    assert np.abs(glb.posed() - glb.attribute("POSITION")).max() < 1e-5
    hip = glb.json["nodes"][1]
    assert hip["name"] == "left_hip"
    turn = Rotation.from_quat(hip["rotation"]).as_rotvec()
    np.testing.assert_allclose(turn, (0, 0, np.pi / 6), atol=1e-6)


def test_a_clip_without_blend_shapes(run, motion, tmp_path):
    report = run.fit.avatar.export_glb(
        tmp_path / "a.glb", motion[:2], expressions=False, verbose=False
    )
    assert report.influence_loss is not None
    assert validation_report(report.path)["issues"]["numErrors"] == 0


def test_weights_file_is_the_avatar(run, tmp_path):
    avatar = run.fit.avatar
    avatar.export_weights(tmp_path / "w.npz")
    with np.load(tmp_path / "w.npz", allow_pickle=False) as read:
        weights = np.asarray(avatar.skin_weights(jnp.asarray(read["vertices"])))
        np.testing.assert_allclose(read["weights"], weights, atol=1e-6)
        assert tuple(read["joint_names"].tolist()) == run.body.tree.names
        neutral = xa.canonical_params(run.body, jnp.asarray(avatar.betas))
        joints = np.asarray(xa.pose_body(run.body, neutral).joints)
        np.testing.assert_allclose(read["rest_joints"], joints, atol=1e-5)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failed_export_leaves_what_was_there(run, motion, tmp_path, monkeypatch, error):
    path = tmp_path / "a.glb"
    path.write_bytes(b"before")

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(rigging, "glb_bytes", fail)
    with pytest.raises(type(error)):
        run.fit.avatar.export_glb(path, motion, verbose=False)
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["a.glb"]


def test_unwritable_paths_cost_no_work(run, motion, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("here")
    monkeypatch.setattr(rigging, "build_rig", None)
    with pytest.raises(OSError, match="file"):
        run.fit.avatar.export_glb(tmp_path / "file" / "a.glb", motion)
    with pytest.raises(ValueError, match=r"end in \.glb"):
        run.fit.avatar.export_glb(tmp_path / "a.gltf", motion)
    with pytest.raises(ValueError, match="up axis 'x'"):
        rigging.build_clip("walk", run.fit.avatar.animate(motion), None, up="x")
