"""Body parameters in every container, spelling and nesting, against numbers made here."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
import sys
import types
import warnings
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import writers
from scipy.spatial.transform import Rotation

from xavatar_jax.body import rest_joints
from xavatar_jax.motion import MotionNotice, load_motion

T = 4
CAMERA = np.diag([1.0, -1.0, -1.0])


def read(path, *expected, **options):
    """The motion; its notices hold the words expected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MotionNotice)
        motion = load_motion(path, **options)
    for words in expected:
        assert sum(words in notice for notice in motion.notices) == 1, (words, motion.notices)
    return motion


def smpl(seed=0):
    rng = np.random.default_rng(seed)
    return {
        "global_orient": 0.3 * rng.normal(size=(T, 3)),
        "body_pose": 0.3 * rng.normal(size=(T, 69)),
        "transl": rng.normal(size=(T, 3)),
        "betas": np.tile(rng.normal(size=10), (T, 1)),
    }


def whole(numbers):
    return np.concatenate([numbers["global_orient"], numbers["body_pose"]], axis=1)


@contextlib.contextmanager
def torch_names():
    """PyTorch's names as they stand in its files, for as long as something is pickled."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    rebuild = types.FunctionType((lambda *_: None).__code__, {}, "_rebuild_tensor_v2")
    storage = type("FloatStorage", (), {"__module__": "torch"})
    rebuild.__module__, rebuild.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    utils._rebuild_tensor_v2, torch.FloatStorage, torch._utils = rebuild, storage, utils
    modules = {"torch": torch, "torch._utils": utils}
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        yield rebuild, storage
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module


def torch_save(path, value):
    arrays: list[np.ndarray] = []

    class Storage:
        def __init__(self, kind, array):
            self.identifier = ("storage", kind, str(len(arrays)), "cpu", array.size)
            arrays.append(array)

    with torch_names() as (rebuild, kind):

        class Tensor:
            def __init__(self, values):
                self.values = np.ascontiguousarray(values, "<f4")

            def __reduce__(self):
                strides = tuple(s // 4 for s in self.values.strides)
                storage = Storage(kind, self.values)
                return rebuild, (storage, 0, self.values.shape, strides, False, OrderedDict())

        class Pickler(pickle.Pickler):
            def persistent_id(self, obj):
                return obj.identifier if isinstance(obj, Storage) else None

        def wrapped(entry):
            if isinstance(entry, dict):
                return {key: wrapped(child) for key, child in entry.items()}
            return Tensor(entry)

        stream = io.BytesIO()
        Pickler(stream, 2).dump(wrapped(value))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("results/data.pkl", stream.getvalue())
        for k, array in enumerate(arrays):
            archive.writestr(f"results/data/{k}", array.tobytes())
    return path


def save(path, data):
    """The same dictionary in the container that the name asks for."""
    if path.suffix == ".npz":
        np.savez(path, **data)
    elif path.suffix == ".npy":
        np.save(path, np.array(data, object), allow_pickle=True)
    elif path.suffix == ".pt":
        torch_save(path, data)
    elif path.suffix == ".json":
        path.write_text(json.dumps(data, default=lambda values: values.tolist()))
    else:
        path.write_bytes(pickle.dumps(data))
    return path


CONTAINERS = ["npz", "npy", "pkl", "pt", "json"]


def is_smpl(motion, numbers, start=0.0):
    assert motion.model == "smpl"
    np.testing.assert_allclose(motion.poses.reshape(T, 72), whole(numbers), atol=1e-6)
    np.testing.assert_allclose(motion.transl, numbers["transl"] - start, atol=1e-6)


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("spelling", ["split", "whole", "prefixed", "matrices", "nested"])
def test_smpl_in_every_container(tmp_path, family, container, spelling):
    numbers = smpl()
    data = {
        "split": numbers,
        "whole": {"poses": whole(numbers), "trans": numbers["transl"]},
        "prefixed": {"smpl_poses": whole(numbers), "smpl_trans": numbers["transl"]},
        "matrices": {
            "global_orient": writers.matrices(numbers["global_orient"].reshape(T, 1, 3)),
            "body_pose": writers.matrices(numbers["body_pose"].reshape(T, 23, 3)),
            "transl": numbers["transl"],
        },
        "nested": {"smpl": numbers},
    }[spelling]
    path = save(tmp_path / f"a.{container}", data)
    is_smpl(read(path, "BODY ONLY", "no frame rate"), numbers)
    motion = read(path, body=family["smpl"])
    assert not any("BODY ONLY" in notice for notice in motion.notices)
    params = motion.to_params(family["smpl"])
    np.testing.assert_allclose(np.reshape(params.pose, (T, 72)), whole(numbers), atol=1e-6)


def test_smpl_in_the_layout_of_amass(tmp_path):
    numbers = smpl()
    np.savez(tmp_path / "a.npz", poses=whole(numbers), trans=numbers["transl"], fps=60.0)
    motion = read(tmp_path / "a.npz", "BODY ONLY")
    assert (motion.fps, motion.up) == (60.0, "z")
    is_smpl(motion, numbers)


def test_a_dictionary_of_amass_in_other_containers(tmp_path):
    poses = 0.3 * np.random.default_rng(0).normal(size=(T, 165))
    data = {"poses": poses, "trans": np.ones((T, 3)), "betas": np.zeros(10)}
    for container in CONTAINERS:
        path = save(tmp_path / f"a.{container}", data | {"mocap_framerate": np.array(50.0)})
        motion = read(path)
        assert (motion.up, motion.fps) == ("z", 50.0)
        np.testing.assert_allclose(motion.poses.reshape(T, 165), poses, atol=1e-6)


def test_rotations_of_every_model_in_one_array(tmp_path):
    for width, joints, model in ((66, 55, "smplx"), (156, 52, "smplh"), (165, 55, "smplx")):
        poses = 0.2 * np.random.default_rng(width).normal(size=(T, width))
        motion = read(save(tmp_path / "a.pkl", {"full_pose": poses}))
        assert (motion.model, motion.poses.shape) == (model, (T, joints, 3))
        flat = motion.poses.reshape(T, -1)
        np.testing.assert_array_equal(flat[:, :width], poses)
        np.testing.assert_array_equal(flat[:, width:], 0)


# Places and scales


def test_scale_and_translation_place_the_body(tmp_path):
    numbers = smpl()
    shift, scale = np.arange(3.0), np.array([0.5])
    data = numbers | {"scale": scale, "translation": shift}
    motion = read(save(tmp_path / "a.pkl", data), "scale of 0.5 to 0.5")
    np.testing.assert_allclose(motion.transl, numbers["transl"] + shift / 0.5)
    data = {"smpl_poses": whole(numbers), "smpl_scaling": np.array([90.0]), "smpl_trans": np.eye(3)}
    data["smpl_trans"] = 90 * numbers["transl"]
    is_smpl(read(save(tmp_path / "b.pkl", data), "scaling of 90"), numbers)
    for bad in (0.0, -1.0, np.nan):
        path = save(tmp_path / "c.pkl", numbers | {"scale": np.array([bad])})
        with pytest.raises(ValueError, match=r"c\.pkl: scale is"):
            load_motion(path)


def test_entries_that_are_not_used_are_named_once(tmp_path):
    data = {"person": smpl() | {"verts": np.zeros((T, 5)), "gender": "male"}, "K": np.eye(3)}
    assert read(save(tmp_path / "a.pkl", data), "ignored entries: K, verts").gender == "male"


# Results of estimators


def test_gvhmr_gives_the_world(tmp_path):
    numbers = writers.smplx_numbers(T)
    world = {n: numbers[n] for n in ("global_orient", "body_pose", "transl", "betas")}
    camera = world | {"global_orient": world["global_orient"] + 1, "transl": world["transl"] + 1}
    result = {"smpl_params_global": world, "smpl_params_incam": camera}
    path = torch_save(tmp_path / "hmr4d_results.pt", result | {"K_fullimg": np.zeros((T, 3, 3))})
    motion = read(path, "ignored entries: K_fullimg")
    assert (motion.up, motion.model) == ("y", "smplx")
    assert not any("taken as y-up" in notice for notice in motion.notices)
    np.testing.assert_allclose(motion.joint("pelvis"), world["global_orient"], atol=1e-6)
    np.testing.assert_allclose(motion.joint("left_knee"), world["body_pose"][:, 9:12], atol=1e-6)
    np.testing.assert_allclose(motion.transl, world["transl"], atol=1e-6)
    # Without the world, the camera's are turned upright.
    motion = read(torch_save(tmp_path / "b.pt", {"smpl_params_incam": camera}))
    upright = Rotation.from_matrix(CAMERA) * Rotation.from_rotvec(camera["global_orient"])
    error = upright.inv() * Rotation.from_rotvec(motion.joint("pelvis"))
    assert error.magnitude().max() < 1e-6


def wham(numbers, frames):
    camera = numbers | {"global_orient": numbers["global_orient"] + 1}
    return {
        "pose": whole(camera), "trans": numbers["transl"] + 1, "pose_world": whole(numbers),
        "trans_world": numbers["transl"], "betas": numbers["betas"],
        "verts": np.zeros((T, 9, 3)), "frame_ids": np.asarray(frames),
    }  # fmt: skip


def test_wham_people_and_gaps(tmp_path):
    one, two = smpl(0), smpl(1)
    result = {0: wham(one, range(T)), 3: wham(two, (0, 1, 3, 4))}
    path = writers.joblib_dump(tmp_path / "wham_output.pkl", result)
    with pytest.raises(ValueError, match=r"2 people: 0 \(4 frames\), 3 \(4 frames\).*person="):
        load_motion(path)
    is_smpl(read(path, person=0), one)
    motion = read(path, "1 of 5 frames are missing", person=3)
    np.testing.assert_allclose(motion.transl[[0, 1, 3, 4]], two["transl"], atol=1e-12)
    middle = (two["transl"][1] + two["transl"][2]) / 2
    np.testing.assert_allclose(motion.transl[2], middle, atol=1e-12)


def test_tram_stands_in_the_camera(tmp_path, family):
    numbers, body = smpl(), family["smpl"]
    result = {
        "pred_rotmat": writers.matrices(whole(numbers).reshape(T, 24, 3)),
        "pred_pose": np.zeros((T, 144)), "pred_shape": numbers["betas"],
        "pred_trans": numbers["transl"].reshape(T, 1, 3), "pred_cam": np.zeros((T, 3)),
        "frame": np.arange(T),
    }  # fmt: skip
    motion = read(save(tmp_path / "hps_track_0.npy", result), body=body)
    pelvis = np.asarray(rest_joints(body, numbers["betas"][0])[0])
    expected = (numbers["transl"] + pelvis) @ CAMERA.T - pelvis
    np.testing.assert_allclose(motion.transl, expected, atol=1e-5)
    np.testing.assert_allclose(motion.joint("left_knee"), whole(numbers)[:, 12:15], atol=1e-6)


def test_prompthmr_people(tmp_path):
    rng = np.random.default_rng(0)
    person = {"pose": 0.3 * rng.normal(size=(3, 165)), "trans": rng.normal(size=(3, 3)),
              "shape": np.tile(rng.normal(size=10), (3, 1))}  # fmt: skip
    entry = {"smplx_world": person, "smplx_cam": person | {"pose": person["pose"] + 1},
             "frames": np.array([4, 5, 7]), "track_id": 2}  # fmt: skip
    result = {"people": {2: entry}, "camera": {"img_focal": 1000.0}}
    path = writers.joblib_dump(tmp_path / "results.pkl", result)
    motion = read(path, "1 of 4 frames are missing")
    np.testing.assert_allclose(motion.poses[[0, 1, 3]].reshape(3, 165), person["pose"], atol=1e-7)
    np.testing.assert_allclose(motion.betas, person["shape"][0])


def test_romp_frames_and_people(tmp_path):
    one, two = smpl(0), smpl(1)

    def frame(k):
        rows = np.stack([whole(one)[k], whole(two)[k]])
        return {
            "cam": np.zeros((2, 3)), "global_orient": rows[:, :3], "body_pose": rows[:, 3:],
            "smpl_thetas": rows, "smpl_betas": np.zeros((2, 10)), "track_ids": np.array([5, 9]),
            "cam_trans": np.stack([one["transl"][k], two["transl"][k]]),
        }  # fmt: skip

    path = tmp_path / "video_results.npz"
    np.savez(path, results=np.array({f"{k:08d}.jpg": frame(k) for k in range(T)}, object))
    with pytest.raises(ValueError, match=r"2 people: 5 \(4 frames\), 9 \(4 frames\)"):
        load_motion(path)
    motion = read(path, "BODY ONLY", person=9)
    np.testing.assert_allclose(motion.poses[:, 1:].reshape(T, 69), two["body_pose"], atol=1e-12)
    steps = np.diff(two["transl"], axis=0)
    np.testing.assert_allclose(np.diff(motion.transl, axis=0), steps @ CAMERA, atol=1e-12)


def test_glamr_gives_the_place_of_the_pelvis(tmp_path, family):
    numbers, body = smpl(), family["smpl"]
    person = {
        "smpl_pose": numbers["body_pose"], "smpl_beta": numbers["betas"], "scale": None,
        "smpl_orient_world": numbers["global_orient"], "root_trans_world": numbers["transl"],
        "smpl_orient_cam": numbers["global_orient"] + 1, "root_trans_cam": numbers["transl"] + 1,
        "frames": np.arange(T),
    }  # fmt: skip
    path = writers.joblib_dump(tmp_path / "a_seed1.pkl", {"person_data": {0: person}, "meta": {}})
    motion = read(path, body=body)
    assert motion.up == "z"
    pelvis = np.asarray(rest_joints(body, numbers["betas"][0])[0], np.float64)
    is_smpl(motion, numbers, pelvis)
    with pytest.raises(ValueError, match=r"root_trans is the position of the pelvis.*body="):
        load_motion(path)


# Rows and folders


def test_rows_of_motion_x_and_of_rotations(tmp_path):
    rows = 0.1 * np.random.default_rng(0).normal(size=(T, 322))
    np.save(tmp_path / "a.npy", rows)
    motion = read(tmp_path / "a.npy", "ignored entries: face_shape")
    order = np.concatenate([np.arange(66), np.arange(156, 159), np.arange(66, 156)])
    eyes = [23, 24]
    np.testing.assert_array_equal(np.delete(motion.poses, eyes, 1).reshape(T, 159), rows[:, order])
    np.testing.assert_array_equal(motion.poses[:, eyes], 0)
    np.testing.assert_array_equal(motion.expression, rows[:, 159:209])
    np.testing.assert_array_equal(motion.transl, rows[:, 309:312])
    np.testing.assert_allclose(motion.betas, rows[:, 312:].mean(axis=0))
    np.save(tmp_path / "b.npy", rows[:, :165])
    motion = read(tmp_path / "b.npy", "rows of 165 numbers are taken as rotations of 55 joints")
    np.testing.assert_array_equal(motion.poses.reshape(T, 165), rows[:, :165])


def test_people_in_rows(tmp_path):
    one, two = smpl(0), smpl(1)
    data = {name: np.stack([one[name], two[name]]) for name in one}
    path = save(tmp_path / "a.npz", data)
    with pytest.raises(ValueError, match=r"2 people: 0 \(4 frames\), 1 \(4 frames\)"):
        load_motion(path)
    is_smpl(read(path, person=1), two)


@pytest.mark.parametrize("name", ["{}.json", "frame_{:04d}.npz", "{:06d}.pkl"])
def test_a_file_for_each_frame(tmp_path, name):
    numbers = smpl()
    for k in range(T):
        frame = {key: values[k] for key, values in numbers.items()}
        save(tmp_path / name.format(k + 9), frame)
    is_smpl(read(tmp_path, "BODY ONLY"), numbers)


# What cannot be read


def test_sam_3d_body_results_say_how_to_proceed(tmp_path):
    person = {"mhr_model_params": np.zeros(204), "body_pose_params": np.zeros(133)}
    for name, data in (("a.pkl", person), ("b.json", {"people": [person]})):
        with pytest.raises(ValueError, match=rf"{name}: holds .*SAM 3D Body.*MHR.*conversion"):
            load_motion(save(tmp_path / name, data))
    np.savez(tmp_path / "c.npz", data=np.array([person], object))
    with pytest.raises(ValueError, match=r"c\.npz: holds .*SAM 3D Body"):
        load_motion(tmp_path / "c.npz")


def test_embeddings_are_named(tmp_path):
    orient = {"global_orient": np.zeros((1, 3))}
    for data in (
        orient | {"body_pose": np.ones((1, 32))}, orient | {"pose_embedding": np.ones((1, 32))},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"a\.pkl.*embedding.*VPoser.*Decode it"):
            load_motion(save(tmp_path / "a.pkl", data))


def test_degrees_are_named(tmp_path):
    numbers = smpl()
    degrees = numbers | {"body_pose": np.degrees(numbers["body_pose"])}
    poses = np.degrees(np.random.default_rng(0).normal(size=(T, 165)))
    spinning = np.zeros((T, 165))
    spinning[:, 1] = 20 * np.pi  # a body, not a joint, turns many times
    for data in (degrees, {"poses": poses, "trans": np.zeros((T, 3)), "fps": np.array(30)}):
        with pytest.raises(ValueError, match=r"a\.npz: .*pose.*only be in degrees.*np\.radians"):
            load_motion(save(tmp_path / "a.npz", data))
    read(save(tmp_path / "b.npz", {"poses": spinning, "trans": np.zeros((T, 3)), "fps": 30}))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("a.json", {"global_orient": ["x", 0, 0]}, r"global_orient holds \['x', 0, 0\] \(list\)"),
        ("a.json", {"body_pose": [[1, 2], [3]]}, "body_pose"),
        ("a.pkl", {"body_pose": "pose"}, "body_pose holds 'pose'"),
        ("a.pkl", {"transl": np.zeros(2)}, "transl has shape"),
        ("a.json", {"transl": [[10**400, 0, 0]]}, "transl is not finite"),
        ("a.pkl", {"fps": "many"}, "fps holds 'many'"),
        ("a.pkl", {"scale": {"x": 1}}, "scale holds"),
    ],
)
def test_values_that_cannot_be_read_are_named(tmp_path, name, change, message):
    data = {"global_orient": [0, 0, 0], "body_pose": [0] * 63} | change
    with pytest.raises(ValueError, match=message) as error:
        load_motion(save(tmp_path / name, data))
    assert name in str(error.value)


def test_frame_numbers_beyond_range_are_errors(tmp_path):
    for number in (0, 10**20):
        save(tmp_path / f"{number}.json", {"global_orient": [0] * 3, "body_pose": [0] * 63})
    with pytest.raises(ValueError, match="cannot be read as such"):
        load_motion(tmp_path)
