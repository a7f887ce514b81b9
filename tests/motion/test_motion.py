from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from xavatar_jax.body import SMPLX_TREE, pose_body
from xavatar_jax.motion import Motion, MotionNotice, load_motion, rest_pelvis, save_amass

NAMES = SMPLX_TREE.names


def some_motion(count=4, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "poses": 0.4 * rng.normal(size=(count, 55, 3)),
        "transl": rng.normal(size=(count, 3)),
        "joint_names": NAMES,
        "fps": 30.0,
        "betas": rng.normal(size=10),
        "expression": rng.normal(size=(count, 10)),
        "up": "z",
        "gender": "female",
    }
    return Motion(**{**fields, **changes})


def amass_arrays(count=5, seed=1):
    """An archive as AMASS publishes it, written by hand."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(count, 165))
    return {
        "gender": np.array("female"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(120.0),
        "trans": rng.normal(size=(count, 3)),
        "poses": poses,
        "betas": rng.normal(size=16),
        "root_orient": poses[:, :3],
        "pose_body": poses[:, 3:66],
        "pose_jaw": poses[:, 66:69],
        "pose_eye": poses[:, 69:75],
        "pose_hand": poses[:, 75:],
    }


@eqx.filter_jit
def _posed(body, params):
    return jax.vmap(lambda p: pose_body(body, p).vertices)(params)


def posed(body, motion):
    return np.asarray(_posed(body, motion.to_params(body)))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000))
def test_rotating_the_world_rotates_posed_vertices(toy_body, seed):
    motion = some_motion(seed=seed)
    rotation = Rotation.random(rng=seed).as_matrix()
    turned = motion.rotate(rotation, rest_pelvis(toy_body, motion.betas))
    np.testing.assert_allclose(
        posed(toy_body, turned), posed(toy_body, motion) @ rotation.T, atol=1e-5
    )


def test_y_up_and_back(toy_body):
    motion = some_motion()
    y_up = motion.to_y_up(toy_body)
    # z of the one world is y of the other, and what was y points backwards.
    before, after = posed(toy_body, motion), posed(toy_body, y_up)
    np.testing.assert_allclose(after[..., 1], before[..., 2], atol=1e-5)
    np.testing.assert_allclose(after[..., 2], -before[..., 1], atol=1e-5)
    assert y_up.up == "y"
    back = y_up.to_z_up(toy_body)
    np.testing.assert_allclose(posed(toy_body, back), before, atol=1e-5)
    assert motion.to_z_up(toy_body) is motion


def test_rotate_refuses_what_is_no_rotation():
    for wrong in (np.diag([1.0, 1.0, -1.0]), 2 * np.eye(3), np.eye(4)):
        with pytest.raises(ValueError, match="Not a rotation matrix"):
            some_motion().rotate(wrong, np.zeros(3))


@pytest.mark.parametrize("spelling", ["mocap_frame_rate", "mocap_framerate"])
@pytest.mark.parametrize("split", [False, True])
def test_amass_archives_are_read(tmp_path, spelling, split):
    arrays = amass_arrays()
    arrays[spelling] = arrays.pop("mocap_frame_rate")
    expected = arrays["poses"].reshape(5, 55, 3)
    if split:
        del arrays["poses"]
    np.savez(tmp_path / "walk_stageii.npz", **arrays)
    motion = load_motion(tmp_path / "walk_stageii.npz")
    np.testing.assert_array_equal(motion.poses, expected)
    np.testing.assert_array_equal(motion.joint("jaw"), arrays["pose_jaw"])
    np.testing.assert_array_equal(motion.joint("left_index1"), arrays["pose_hand"][:, :3])
    np.testing.assert_array_equal(motion.joint("right_index1"), arrays["pose_hand"][:, 45:48])
    np.testing.assert_array_equal(motion.transl, arrays["trans"])
    assert (motion.fps, motion.gender, motion.up, len(motion.betas)) == (120.0, "female", "z", 16)


def test_smplh_archives_with_bytes_are_read(tmp_path):
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(3, 156))
    np.savez(
        tmp_path / "h.npz", poses=poses, trans=np.zeros((3, 3)), gender=np.array(b"male"),
        mocap_framerate=60, betas=np.zeros(16), dmpls=np.zeros((3, 8)),
    )  # fmt: skip
    motion = load_motion(tmp_path / "h.npz")
    assert motion.gender == "male"
    assert "jaw" not in motion.joint_names
    np.testing.assert_array_equal(motion.joint("left_index1"), poses[:, 66:69])


def test_smplh_motion_drives_a_smplx_body_with_a_notice(toy_body):
    names = tuple(n for n in NAMES if n not in ("jaw", "left_eye", "right_eye"))
    motion = some_motion(poses=np.ones((4, 52, 3)), joint_names=names)
    with pytest.warns(MotionNotice, match="no rotations for 3 joints"):
        params = motion.to_params(toy_body)
    np.testing.assert_array_equal(params.jaw_pose, 0)
    np.testing.assert_array_equal(params.right_hand_pose, 1)


def test_too_many_coefficients_are_cut_with_a_notice(toy_body):
    with pytest.warns(MotionNotice, match="16 betas given, the body has 10"):
        params = some_motion(betas=np.ones(16)).to_params(toy_body)
    assert params.betas.shape == (4, 10)
    params = some_motion(betas=np.ones(4), expression=None).to_params(toy_body)
    np.testing.assert_array_equal(params.betas[0], [1, 1, 1, 1, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("drop", "message"),
    [
        (("poses", "root_orient"), "no root_orient.*Looked for poses, or for.*found.*trans"),
        (("trans",), "no trans or transl; found"),
        (("mocap_frame_rate",), "no frame rate.*mocap_framerate.*Give fps="),
    ],
)
def test_missing_keys_list_what_was_sought_and_found(tmp_path, drop, message):
    arrays = {k: v for k, v in amass_arrays().items() if k not in drop}
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        load_motion(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("poses", np.zeros((5, 75)), r"poses has shape \(5, 75\).*165"),
        ("trans", np.full((5, 3), np.nan), "transl is not finite in 5 frames, first in frame 0"),
        ("trans", np.zeros((4, 3)), r"transl has shape \(4, 3\), expected \(5, 3\)"),
        ("mocap_frame_rate", np.array(0.0), "frame rate 0.0"),
        ("betas", np.arange(10.0).reshape(5, 2), "differ between frames"),
    ],
)
def test_wrong_values_name_file_and_field(tmp_path, key, value, message):
    np.savez(tmp_path / "a.npz", **{**amass_arrays(), key: value})
    with pytest.raises(ValueError, match=message) as error:
        load_motion(tmp_path / "a.npz")
    assert "a.npz" in str(error.value)


def test_missing_file_and_wrong_format(tmp_path):
    with pytest.raises(FileNotFoundError, match="No motion file or folder"):
        load_motion(tmp_path / "none.npz")
    (tmp_path / "a.bvh").write_text("x")
    with pytest.raises(ValueError, match="not recognised as a motion; found neither"):
        load_motion(tmp_path / "a.bvh")


class Evil:
    def __reduce__(self):
        return (print, ("run",))


def test_code_in_an_archive_is_refused(tmp_path):
    arrays = {**amass_arrays(), "gender": np.array(Evil(), dtype=object)}
    np.savez(tmp_path / "evil.npz", **arrays)
    with pytest.raises(ValueError, match="not plain data"):
        load_motion(tmp_path / "evil.npz")


def test_grab_archives_with_nested_dictionaries_are_read(tmp_path):
    rng = np.random.default_rng(3)
    pose = rng.normal(size=(6, 165))
    params = {"fullpose": pose, "transl": np.ones((6, 3)), "expression": np.ones((6, 10))}
    np.savez(
        tmp_path / "cup.npz", gender="female", framerate=120.0, n_frames=6,
        body={"params": params, "vtemp": "tools/subject_meshes/female/s1.ply"}, contact={},
    )  # fmt: skip
    motion = load_motion(tmp_path / "cup.npz")
    np.testing.assert_array_equal(motion.poses.reshape(6, 165), pose)
    assert motion.template == "tools/subject_meshes/female/s1.ply"
    assert (motion.fps, motion.gender) == (120.0, "female")


def test_saved_archives_hold_every_key_and_no_pickle(tmp_path):
    motion = some_motion(count=6, betas=np.arange(16.0))
    path = save_amass(tmp_path / "out.npz", motion)
    with np.load(path, allow_pickle=False) as file:
        data = {key: file[key] for key in file.files}
    assert data["mocap_frame_rate"] == data["mocap_framerate"] == 30.0
    np.testing.assert_array_equal(data["expression"], data["expressions"])
    parts = [data[k] for k in ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), data["poses"])
    assert data["poses"].shape == (6, 165)
    assert data["gender"] == "female"
    read = load_motion(path)
    for name in ("poses", "transl", "betas", "expression"):
        np.testing.assert_array_equal(getattr(read, name), getattr(motion, name))


def test_only_z_up_smplx_motions_are_saved(tmp_path):
    with pytest.raises(ValueError, match="z-up and this motion is y-up"):
        save_amass(tmp_path / "a.npz", some_motion(up="y"))
    motion = some_motion(poses=np.zeros((4, 1, 3)), joint_names=("tail",))
    with pytest.raises(ValueError, match="not among them: tail"):
        save_amass(tmp_path / "a.npz", motion)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device")

    save_amass(tmp_path / "a.npz", some_motion())
    before = (tmp_path / "a.npz").read_bytes()
    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_amass(tmp_path / "a.npz", some_motion(seed=2))
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]
    assert (tmp_path / "a.npz").read_bytes() == before


def test_resampling_follows_the_shortest_arc():
    # A joint that turns steadily about one axis, through more than half a turn.
    angle = np.linspace(0, 4.0, 9)
    poses = np.zeros((9, 2, 3))
    poses[:, 1, 2] = angle
    motion = Motion(
        poses=poses, transl=np.outer(angle, [1.0, 0, 0]), joint_names=("a", "b"), fps=8.0
    )
    finer = motion.resample(20.0)
    assert len(finer) == 21
    assert finer.fps == 20.0
    assert finer.seconds == pytest.approx(1.0)
    expected = Rotation.from_rotvec(np.outer(np.linspace(0, 4, 21), [0, 0, 1.0]))
    error = (expected.inv() * Rotation.from_rotvec(finer.poses[:, 1])).magnitude()
    assert error.max() < 1e-9
    np.testing.assert_allclose(finer.transl[:, 0], np.linspace(0, 4, 21), atol=1e-9)
    assert motion.resample(8.0) is motion
    with pytest.raises(ValueError, match="must be positive"):
        motion.resample(0)
    assert len(motion[:1].resample(30.0)) == 1


def test_cutting_keeps_time():
    motion = some_motion(count=10)
    part = motion[2:10:2]
    assert (len(part), part.fps) == (4, 15.0)
    np.testing.assert_array_equal(part.expression, motion.expression[2:10:2])
    with pytest.raises(TypeError, match="slice"):
        motion[3]


def test_params_round_trip(toy_body):
    motion = some_motion(up="y")
    back = Motion.from_params(motion.to_params(toy_body), fps=30.0)
    np.testing.assert_allclose(back.poses, motion.poses, atol=1e-6)
    np.testing.assert_allclose(back.betas, motion.betas, atol=1e-6)
    params = motion.to_params(toy_body)
    betas = np.array(params.betas)
    betas[1] += 1
    with pytest.raises(ValueError, match="betas differ between frames by up to 1"):
        Motion.from_params(replace(params, betas=betas), fps=30.0)


def test_bad_records_are_refused():
    with pytest.raises(ValueError, match=r"poses has shape \(4, 54, 3\)"):
        some_motion(poses=np.zeros((4, 54, 3)))
    with pytest.raises(ValueError, match="no frames"):
        some_motion(poses=np.zeros((0, 55, 3)), transl=np.zeros((0, 3)), expression=None)
    with pytest.raises(ValueError, match="up axis 'x'"):
        some_motion(up="x")
