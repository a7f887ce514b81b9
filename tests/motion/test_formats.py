"""Each reader on a file made by the writers beside this, and files that are no motion."""

from __future__ import annotations

import json
import pickle
import warnings

import numpy as np
import pytest
import writers
from helpers import COLUMNS, PARENTS, reference_body, toy_arrays
from scipy.spatial.transform import Rotation

from xavatar_jax.avatar import body_only
from xavatar_jax.body import SMPLX_TREE, BodyParams, hands_to_relative
from xavatar_jax.files import UnsafePickleError
from xavatar_jax.motion import FORMATS, Motion, MotionNotice, load_motion, save_motion
from xavatar_jax.motion.values import doubled_mean_notice

CAMERA = np.diag([1.0, -1.0, -1.0])  # OpenCV's axes to y-up ones


def read(path, *expected, **options):
    """The motion, and that its warnings are its notices and hold the words expected."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = load_motion(path, **options)
    said = [str(w.message) for w in caught if w.category is MotionNotice]
    assert said == list(motion.notices)
    assert len(said) == len(caught)
    for words in expected:
        assert any(words in notice for notice in said), (words, said)
    return motion


def posed(body, motion):
    """Vertices over time of one of the small bodies, by the plain reference."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MotionNotice)
        return posed_params(body, motion.to_params(body))


def posed_params(body, params):
    arrays = toy_arrays(PARENTS[body.kind], columns=COLUMNS[body.kind])
    expression = np.asarray(params.expression) if body.num_expression else None
    numbers = zip(*map(np.asarray, (params.betas, params.pose, params.transl)), strict=True)
    return np.stack(
        [
            reference_body(arrays, *frame, None if expression is None else expression[k])[0]
            for k, frame in enumerate(numbers)
        ]
    )


def posed_numbers(body, numbers):
    """Vertices of parameters by name, hands absolute."""
    return posed_params(body, BodyParams.create(body, **numbers))


def with_mean(body, numbers):
    """Absolute hands from hands relative to the mean."""
    mean = np.asarray(body.hand_mean)
    parts = {"left_hand_pose": slice(25, 40), "right_hand_pose": slice(40, 55)}
    return numbers | {n: numbers[n] + mean[joints].ravel() for n, joints in parts.items()}


def still_face(numbers):
    """Without expression, which would move the random body's pelvis, as no real body's does."""
    return numbers | {"expression": np.zeros_like(numbers["expression"])}


@pytest.fixture
def body(family):
    return family["smplx"]


# X-Humans


def test_xhumans_sequences(tmp_path, body):
    numbers = writers.smplx_numbers(4)
    folder = writers.xhumans(tmp_path / "00016", numbers)
    (tmp_path / "00016" / "gender.txt").write_text("female\n")
    np.save(tmp_path / "00016" / "mean_shape_smplx.npy", np.arange(10.0) / 10)
    for path in (folder, folder.parent):
        motion = read(path, "no frame rate: 30", body=body)
        assert (motion.fps, motion.gender, motion.up, len(motion)) == (30.0, "female", "y", 4)
        np.testing.assert_array_equal(motion.betas, np.arange(10.0) / 10)
    numbers["betas"] = np.tile(motion.betas, (4, 1))
    expected = posed_numbers(body, with_mean(body, numbers))
    np.testing.assert_allclose(posed(body, motion), expected, atol=2e-5)
    absolute = read(folder, fps=30.0, flat_hand_mean=True)
    np.testing.assert_allclose(
        absolute.joint("right_thumb3"), numbers["right_hand_pose"][:, -3:], atol=1e-7
    )


def test_hands_relative_to_the_mean_need_a_body(tmp_path):
    folder = writers.xhumans(tmp_path, writers.smplx_numbers(2))
    with pytest.raises(ValueError, match=r"mesh-f00001_smplx\.pkl: left_hand_pose.*body="):
        load_motion(folder)


@pytest.mark.parametrize("count", [6, 12, 24, 45])
def test_principal_components_of_hands(tmp_path, body, count):
    numbers = writers.smplx_numbers(3)
    components = 0.1 * np.random.default_rng(5).normal(size=(3, count))
    numbers["left_hand_pose"] = components
    motion = read(writers.xhumans(tmp_path, numbers), body=body, fps=30.0)
    basis = np.asarray(body.hand_components["left"])[:count]
    # Forty-five numbers are a pose: components of that number are not told from it.
    expected = components if count == 45 else components.astype(np.float32) @ basis
    hand = motion.poses[:, 25:40] - np.asarray(body.hand_mean)[25:40]
    np.testing.assert_allclose(hand.reshape(3, 45), expected, atol=1e-6)


def test_missing_frames_are_filled_and_said(tmp_path, body):
    numbers = writers.smplx_numbers(4)
    folder = writers.xhumans(tmp_path, numbers)
    (folder / "mesh-f00003_smplx.pkl").unlink()
    motion = read(folder, "1 of 4 frames are missing", body=body)
    middle = (numbers["transl"][1] + numbers["transl"][3]) / 2
    np.testing.assert_allclose(motion.transl[2], middle, atol=1e-6)
    turn = Rotation.from_rotvec(numbers["global_orient"])
    halfway = (
        turn[1] * Rotation.from_rotvec((turn[1].inv() * turn[3]).as_rotvec() / 2)
    ).as_rotvec()
    np.testing.assert_allclose(motion.joint("pelvis")[2], halfway, atol=1e-6)


def test_frames_numbered_in_steps_are_consecutive(tmp_path, body):
    folder = writers.xhumans(tmp_path, writers.smplx_numbers(5))
    for number in (2, 4):
        (folder / f"mesh-f{number:05d}_smplx.pkl").unlink()
    assert len(read(folder, "in steps of 2", body=body)) == 3
    (folder / "mesh-f00003_smplx.pkl").rename(folder / "mesh-f09000_smplx.pkl")
    with pytest.raises(ValueError, match="are missing between them"):
        load_motion(folder, body=body)


def test_a_bad_frame_is_named(tmp_path, body):
    numbers = writers.smplx_numbers(3)
    folder = writers.xhumans(tmp_path, numbers)
    bad = folder / "mesh-f00002_smplx.pkl"
    good = pickle.loads(bad.read_bytes())
    for change, message in (
        ({"body_pose": np.full(63, np.nan)}, "body_pose is not finite"),
        ({"body_pose": np.zeros(69)}, "poses of smpl, but of smplx in"),
        ({"body_pose": np.zeros(60)}, r"body_pose has shape \(60,\), expected"),
        ({"body_pose": np.zeros((21, 3, 3))}, "a matrix that is no rotation"),
        ({"transl": np.zeros(2)}, r"transl has shape \(2,\)"),
        ({"global_orient": None}, "no global_orient; found .*body_pose"),
        ({"betas": np.zeros(16)}, "16 betas, but 10 in"),
    ):
        bad.write_bytes(pickle.dumps(good | change))
        with pytest.raises(ValueError, match=message) as error:
            load_motion(folder, body=body)
        assert "mesh-f00002" in str(error.value)


def test_a_hand_with_the_mean_added_twice_is_noticed(tmp_path, body):
    numbers = writers.smplx_numbers(3, size=0.02)
    folder = writers.xhumans(tmp_path / "a", with_mean(body, numbers))
    read(folder, "left hand is nearer to twice the mean hand", body=body)
    motion = read(writers.xhumans(tmp_path / "b", numbers), body=body)
    assert not any("twice" in notice for notice in motion.notices)
    # A body without fingers has no mean hand to be near to.
    pose = 2 * np.asarray(body.hand_mean)[None, 25:40]
    assert doubled_mean_notice(pose, body, "left") is not None
    assert doubled_mean_notice(pose, body_only(body), "left") is None


# Parameters by name in one file


@pytest.mark.parametrize("shape", ["flat", "joints", "matrices"])
def test_parameters_of_many_frames_in_one_file(tmp_path, body, shape):
    numbers = writers.smplx_numbers(3)
    data = dict(numbers)
    for name, values in numbers.items():
        if name.endswith(("pose", "orient")) and shape != "flat":
            rows = values.reshape(3, -1, 3)
            data[name] = rows if shape == "joints" else writers.matrices(rows)
    np.savez(tmp_path / "a.npz", **data)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(data, 2))
    expected = posed_numbers(body, with_mean(body, numbers))
    for name in ("a.npz", "a.pkl"):
        motion = read(tmp_path / name, "relative to the mean", "taken as y-up", body=body)
        np.testing.assert_allclose(posed(body, motion), expected, atol=2e-5)


def test_what_parameters_lack_is_zero_and_said(tmp_path):
    numbers = writers.smplx_numbers(2)
    kept = {name: numbers[name] for name in ("global_orient", "body_pose")}
    np.savez(tmp_path / "a.npz", **kept)
    motion = read(tmp_path / "a.npz", "no jaw_pose, leye_pose, reye_pose, left_hand_pose", fps=25)
    assert motion.fps == 25
    np.testing.assert_array_equal(motion.poses[:, 22:], 0)


def test_a_file_says_itself_that_its_hands_are_absolute(tmp_path):
    numbers = writers.smplx_numbers(2)
    np.savez(tmp_path / "a.npz", flat_hand_mean=True, **numbers)
    motion = read(tmp_path / "a.npz")
    np.testing.assert_array_equal(motion.poses[:, 25:40].reshape(2, 45), numbers["left_hand_pose"])


# SMPLer-X


def test_smplerx_results_stand_upright(tmp_path, body):
    numbers = still_face(writers.smplx_numbers(3))
    folder = writers.smplerx(tmp_path / "out", numbers, (1, 2, 3))
    motion = read(folder, body=body)
    assert (motion.up, len(motion)) == ("y", 3)
    expected = posed_numbers(body, with_mean(body, numbers)) @ CAMERA.T
    np.testing.assert_allclose(posed(body, motion), expected, atol=2e-5)
    assert len(read(folder / "smplx", body=body)) == 3


def test_smplerx_results_of_several_people(tmp_path, body):
    first, second = (writers.smplx_numbers(4, seed=seed) for seed in (0, 1))
    folder = writers.smplerx(tmp_path, first, (1, 2, 3, 4), person=0)
    writers.smplerx(folder, second, (2, 4), person=1)
    with pytest.raises(ValueError, match=r"2 people: 0 \(4 frames\), 1 \(2 frames\).*person="):
        load_motion(folder, body=body)
    motion = read(folder, "in steps of 2", body=body, person=1)
    np.testing.assert_allclose(motion.joint("left_knee"), second["body_pose"][:2, 9:12], atol=1e-7)
    with pytest.raises(ValueError, match="no person 7; there are 0"):
        load_motion(folder, body=body, person=7)


def test_smplestx_results_without_eyes(tmp_path, body):
    numbers = writers.smplx_numbers(2)
    del numbers["leye_pose"], numbers["reye_pose"]
    folder = writers.smplerx(tmp_path, numbers, (0, 1))
    motion = read(folder, "no leye_pose, reye_pose: zero is used", body=body)
    np.testing.assert_array_equal(motion.joint("left_eye"), 0)


def test_formats_in_camera_axes_take_no_up(tmp_path, body):
    folder = writers.smplerx(tmp_path, writers.smplx_numbers(2), (0, 1))
    with pytest.raises(ValueError, match="leave out up="):
        load_motion(folder, body=body, up="z")


# PyMAF-X


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_pymafx_results(tmp_path, body, compress, protocol):
    numbers = still_face(writers.smplx_numbers(5))
    path = tmp_path / "output.pkl"
    writers.joblib_dump(path, writers.pymafx(numbers, 2), protocol=protocol, compress=compress)
    motion = read(path, "assumed focal length", body=body)
    expected = posed_numbers(body, numbers) @ CAMERA.T
    np.testing.assert_allclose(posed(body, motion), expected, atol=2e-5)
    assert motion.expression.shape == (5, 50)
    without = read(path, "displaced by a constant")
    apart = without.transl - motion.transl
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-6)
    np.testing.assert_allclose(without.poses, motion.poses, atol=1e-7)


def test_pymafx_results_of_several_people(tmp_path, body):
    numbers = writers.smplx_numbers(6)
    result = writers.pymafx(numbers, 4)
    result["frame_ids"] = np.array([0, 0, 1, 1, 3, 3])
    result["person_ids"] = [f"img_f{k}_p{k % 2}" for k in range(6)]
    path = writers.joblib_dump(tmp_path / "output.pkl", result)
    with pytest.raises(ValueError, match=r"2 people: 0 \(3 frames\)"):
        load_motion(path, body=body)
    motion = read(path, "1 of 4 frames are missing", body=body, person=1)
    shown = numbers["body_pose"][[1, 3, 5], :3]
    np.testing.assert_allclose(motion.joint("left_hip")[[0, 1, 3]], shown, atol=1e-7)


def test_smoothed_pymafx_results_stay_in_place(tmp_path, body):
    numbers = writers.smplx_numbers(3)
    whole = np.concatenate(
        [numbers["global_orient"], numbers["body_pose"], np.zeros((3, 6))], axis=1
    )
    kept = ("left_hand_pose", "right_hand_pose", "jaw_pose", "expression")
    data = {"body_pose": whole, **{name: numbers[name] for name in kept}}
    (tmp_path / "a_smoothed.pkl").write_bytes(pickle.dumps(data))
    motion = read(tmp_path / "a_smoothed.pkl", "no leye_pose, reye_pose, transl, betas")
    turned = Rotation.from_matrix(CAMERA) * Rotation.from_rotvec(numbers["global_orient"])
    error = turned.inv() * Rotation.from_rotvec(motion.joint("pelvis"))
    assert error.magnitude().max() < 1e-7
    np.testing.assert_array_equal(motion.transl, 0)
    np.testing.assert_array_equal(motion.poses[:, 25:40].reshape(3, 45), numbers["left_hand_pose"])


def test_code_in_a_joblib_result_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return (print, ("run",))

    result = writers.pymafx(writers.smplx_numbers(2), 2)
    for compress in (False, True):
        path = writers.joblib_dump(tmp_path / "e.pkl", result | {"x": Evil()}, compress=compress)
        with pytest.raises(UnsafePickleError, match=r"e\.pkl.*builtins\.print"):
            load_motion(path)


# 4D-Humans and PHALP


def tracks(frames, seed=0):
    rng = np.random.default_rng(seed)
    return {k: (0.3 * rng.normal(size=(24, 3)), rng.normal(size=3)) for k in frames}


def test_phalp_results_move_the_body_only(tmp_path, family):
    track, betas = tracks(range(4)), np.arange(10.0) / 10
    path = writers.joblib_dump(tmp_path / "demo.pkl", writers.phalp({1: track}, betas))
    smpl = family["smpl"]
    motion = read(path, "BODY ONLY", "assumed focal length", body=smpl)
    assert (motion.model, motion.up, len(motion)) == ("smpl", "y", 4)
    pose, camera = (np.stack(values) for values in zip(*track.values(), strict=True))
    params = BodyParams.create(smpl, pose=pose, betas=betas, transl=camera)
    expected = posed_params(smpl, params) @ CAMERA.T
    np.testing.assert_allclose(posed(smpl, motion), expected, atol=2e-5)
    with pytest.warns(MotionNotice) as caught:
        params = motion.to_params(family["smplx"])
    said = " ".join(str(w.message) for w in caught)
    assert "betas are of smpl and have no meaning for the smplx body" in said
    assert "left_hand, right_hand" in said
    np.testing.assert_array_equal(params.betas, 0)
    np.testing.assert_array_equal(params.left_hand_pose, 0)


def test_phalp_tracks_with_gaps_and_other_people(tmp_path):
    one, two = tracks((0, 1, 2, 5, 6)), tracks((3, 4), seed=1)
    path = writers.joblib_dump(tmp_path / "demo.pkl", writers.phalp({1: one, 2: two}, np.zeros(10)))
    with pytest.raises(ValueError, match=r"2 people: 1 \(5 frames\), 2 \(2 frames\)"):
        load_motion(path)
    motion = read(path, "2 of 7 frames are missing, up to 2 in a row", person=1)
    np.testing.assert_allclose(motion.joint("left_knee")[5], one[5][0][4], atol=1e-7)
    assert len(motion) == 7


# EasyMocap


def easymocap_numbers(count, width, seed=0):
    rng = np.random.default_rng(seed)
    poses = 0.3 * rng.normal(size=(count, width))
    poses[:, :3] = 0
    return {
        "Rh": rng.normal(size=(count, 3)),
        "Th": rng.normal(size=(count, 3)),
        "poses": poses,
        "shapes": np.tile(rng.normal(size=10), (count, 1)),
        "expression": rng.normal(size=(count, 10)),
    }


def test_easymocap_fits_turn_about_the_origin(tmp_path, body):
    numbers = still_face(easymocap_numbers(3, 87))
    motion = read(writers.easymocap(tmp_path, {0: numbers}), "taken as z-up", body=body)
    assert (motion.up, motion.model) == ("z", "smplx")
    poses = numbers["poses"]
    at_rest = {
        "body_pose": poses[:, 3:66],
        "jaw_pose": poses[:, 78:81],
        "leye_pose": poses[:, 81:84],
        "reye_pose": poses[:, 84:87],
        "betas": numbers["shapes"],
        "expression": numbers["expression"],
    }
    for side, columns in (("left", slice(66, 72)), ("right", slice(72, 78))):
        basis = np.asarray(body.hand_components[side])[:6]
        at_rest[f"{side}_hand_pose"] = poses[:, columns] @ basis
    vertices = posed_numbers(body, with_mean(body, at_rest))
    turn = Rotation.from_rotvec(numbers["Rh"]).as_matrix()
    expected = np.einsum("tij,tvj->tvi", turn, vertices) + numbers["Th"][:, None]
    np.testing.assert_allclose(posed(body, motion), expected, atol=5e-5)


@pytest.mark.parametrize(("width", "kind"), [(72, "smpl"), (69, "smpl"), (156, "smplh")])
def test_easymocap_fits_of_other_models(tmp_path, family, width, kind):
    numbers = easymocap_numbers(2, width)
    if width == 69:
        numbers["poses"] = easymocap_numbers(2, 72)["poses"][:, 3:]
    folder = writers.easymocap(tmp_path, {0: numbers})
    motion = read(folder, body=family[kind], up="y")
    assert any("BODY ONLY" in notice for notice in motion.notices) == (kind == "smpl")
    whole = np.pad(numbers["poses"], ((0, 0), (72 - width if width < 72 else 0, 0)))
    params = BodyParams.create(family[kind], pose=whole.reshape(2, -1, 3), betas=numbers["shapes"])
    turn = Rotation.from_rotvec(numbers["Rh"]).as_matrix()
    vertices = posed_params(family[kind], params)
    expected = np.einsum("tij,tvj->tvi", turn, vertices) + numbers["Th"][:, None]
    np.testing.assert_allclose(posed(family[kind], motion), expected, atol=5e-5)
    read(folder, "stands in for that of", body=family["smplx"])


def test_easymocap_people_and_single_documents(tmp_path, body):
    people = {3: easymocap_numbers(2, 87), 8: easymocap_numbers(2, 87, seed=1)}
    folder = writers.easymocap(tmp_path, people)
    with pytest.raises(ValueError, match=r"2 people: 3 \(2 frames\), 8 \(2 frames\)"):
        load_motion(folder, body=body)
    one = read(folder / "smpl" / "000001.json", body=body, person=8)
    assert len(one) == 1
    knee = people[8]["poses"][1, 12:15]
    np.testing.assert_allclose(one.joint("left_knee")[0], knee, atol=1e-7)
    whole = writers.easymocap(tmp_path / "whole", {0: easymocap_numbers(2, 165)})
    with pytest.raises(ValueError, match=r"Rh and Th turn the body about the origin.*body="):
        load_motion(whole)
    people[3]["poses"] = np.zeros((2, 80))
    with pytest.raises(ValueError, match="poses has 80 numbers a frame"):
        load_motion(writers.easymocap(tmp_path / "b", {3: people[3]}), body=body)


# X-Avatar's pose vectors


@pytest.mark.parametrize("hand", [6, 12, 24, 45])
def test_pose_vectors_of_the_reference(tmp_path, body, hand):
    numbers = writers.smplx_numbers(3)
    rng = np.random.default_rng(2)
    left, right = (0.1 * rng.normal(size=(3, hand)) for _ in range(2))
    vectors = np.concatenate(
        [np.ones((3, 1)), numbers["transl"], numbers["global_orient"], numbers["body_pose"],
         left, right, numbers["leye_pose"], numbers["reye_pose"], numbers["jaw_pose"],
         numbers["betas"], numbers["expression"]], axis=1,
    )  # fmt: skip
    assert vectors.shape == (3, 99 + 2 * hand)
    np.save(tmp_path / "a.npy", vectors)
    np.savez(tmp_path / "a.npz", smpl_params=vectors)
    for side, values in (("left", left), ("right", right)):
        basis = np.eye(45) if hand == 45 else np.asarray(body.hand_components[side])[:hand]
        numbers[f"{side}_hand_pose"] = values @ basis
    expected = posed_numbers(body, with_mean(body, numbers))
    for name in ("a.npy", "a.npz"):
        motion = read(tmp_path / name, "no frame rate", body=body)
        np.testing.assert_allclose(posed(body, motion), expected, atol=5e-5)
    np.save(tmp_path / "one.npy", vectors[0])
    assert len(read(tmp_path / "one.npy", body=body)) == 1
    vectors[1, 0] = 1.2
    np.save(tmp_path / "a.npy", vectors)
    with pytest.raises(ValueError, match=r"scale 1 to 1\.2; a motion has none"):
        load_motion(tmp_path / "a.npy", body=body)


# AMASS


def test_components_of_amass_hands_need_to_be_said_of_what(tmp_path, body):
    numbers = writers.smplx_numbers(2)
    hands = 0.1 * np.random.default_rng(0).normal(size=(2, 24))
    np.savez(
        tmp_path / "a.npz", root_orient=numbers["global_orient"], pose_body=numbers["body_pose"],
        pose_hand=hands, pose_jaw=numbers["jaw_pose"], pose_eye=np.zeros((2, 6)),
        trans=numbers["transl"], betas=np.zeros(10), mocap_frame_rate=30,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"pose_hand has shape \(2, 24\).*flat_hand_mean=True"):
        load_motion(tmp_path / "a.npz", body=body)
    flat = read(tmp_path / "a.npz", body=body, flat_hand_mean=True)
    basis = np.asarray(body.hand_components["right"], np.float64)[:12]
    np.testing.assert_allclose(flat.poses[:, 40:].reshape(2, 45), hands[:, 12:] @ basis, atol=1e-7)
    relative = read(tmp_path / "a.npz", body=body, flat_hand_mean=False)
    apart = relative.poses - flat.poses
    np.testing.assert_allclose(apart[0, 25:], np.asarray(body.hand_mean)[25:], atol=1e-7)


def test_archives_of_other_models_are_refused(tmp_path):
    arrays = {"poses": np.zeros((2, 165)), "trans": np.zeros((2, 3)), "mocap_frame_rate": 30.0}
    np.savez(tmp_path / "a.npz", surface_model_type="animal_dog", **arrays)
    with pytest.raises(ValueError, match="surface_model_type is 'animal_dog'"):
        load_motion(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **(arrays | {"poses": np.zeros((2, 75))}))
    with pytest.raises(ValueError, match=r"\(2, 75\).*\(T, 72\) for SMPL"):
        load_motion(tmp_path / "b.npz")


@pytest.mark.parametrize("rate", [-30.0, 0.0, np.nan])
def test_frame_rates_that_cannot_be(tmp_path, rate):
    arrays = {"poses": np.zeros((2, 165)), "trans": np.zeros((2, 3)), "betas": np.zeros(10)}
    np.savez(tmp_path / "a.npz", mocap_frame_rate=rate, **arrays)
    with pytest.raises(ValueError, match=r"a\.npz: frame rate .*; it must be positive.*fps="):
        load_motion(tmp_path / "a.npz")
    assert load_motion(tmp_path / "a.npz", fps=60).fps == 60
    with pytest.raises(ValueError, match="frame rate -1; it must be positive"):
        load_motion(tmp_path / "a.npz", fps=-1)


def test_a_clip_of_one_frame(tmp_path, toy_body):
    arrays = {"trans": np.ones((1, 3)), "betas": np.zeros(10), "mocap_frame_rate": 30.0}
    np.savez(tmp_path / "a.npz", poses=np.full((1, 165), 0.1), **arrays)
    motion = read(tmp_path / "a.npz")
    assert (len(motion), motion.seconds) == (1, 0.0)
    for changed in (motion.resample(60), motion.smooth(0.1), motion.trim(), motion[0:1]):
        np.testing.assert_allclose(changed.poses, motion.poses, atol=1e-12)
    for name in ("b.npz", "b.bvh", "b.npy", "b.pkl"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MotionNotice)
            path = save_motion(tmp_path / name, motion.to_y_up(toy_body), body=toy_body)
            back = load_motion(path, body=toy_body)
        assert len(back) == 1
        np.testing.assert_allclose(back.joint("left_knee"), motion.joint("left_knee"), atol=1e-6)


def test_nan_frames_are_named(tmp_path):
    poses = np.zeros((5, 165))
    poses[2:4, 7] = np.nan
    np.savez(tmp_path / "a.npz", poses=poses, trans=np.zeros((5, 3)), betas=np.zeros(10), fps=30)
    with pytest.raises(ValueError, match="poses is not finite in 2 frames, first in frame 2"):
        load_motion(tmp_path / "a.npz")


# What is no motion


def test_unknown_files_say_what_was_sought_and_found(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=np.zeros(3), faces=np.zeros(3))
    np.save(tmp_path / "a.npy", np.zeros((4, 100)))
    (tmp_path / "a.json").write_text(json.dumps({"frames": []}))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([1, 2]))
    (tmp_path / "a.txt").write_text("words")
    (tmp_path / "a.fbx").write_bytes(b"Kaydara FBX Binary")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "notes.md").write_text("words")
    found = {
        "a.npz": "an .npz archive with faces, vertices",
        "a.npy": "an .npy array of shape (4, 100)",
        "a.json": "a JSON document with frames",
        "a.pkl": "a pickle with a list of 2",
        "a.txt": "neither .npz, .npy, pickle, JSON nor BVH",
        "a.fbx": "neither .npz, .npy, pickle, JSON nor BVH",
        "folder": "a folder with notes.md",
    }
    for name, words in found.items():
        with pytest.raises(ValueError, match="not recognised as a motion") as error:
            load_motion(tmp_path / name)
        message = str(error.value)
        assert name in message
        assert f"found {words}." in message
        assert all(f"\n  {key}: " in message for key in FORMATS)


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.json", "a.pkl"])
def test_damaged_files_are_named(tmp_path, name):
    heads = {"a.npz": b"PK\x03\x04", "a.npy": b"\x93NUMPY", "a.json": b"[1, ", "a.pkl": b"\x80\x04"}
    (tmp_path / name).write_bytes(heads[name] + b"rest")
    with pytest.raises(ValueError, match=rf"{name}: not "):
        load_motion(tmp_path / name)


def test_values_of_other_kinds_are_errors_that_name_the_file(tmp_path):
    path = tmp_path / "odd.pkl"
    for value in (
        {"body": {"params": {"fullpose": ["a"] * 165, "transl": 0}}, "framerate": 1},
        {"smplx_params": [3]},
        {"smplx_params": {"body_pose": 3}},
        {"a": {"smpl": [4], "tid": [1]}},
        {"a": {"smpl": [{}], "tid": [1]}},
        {"global_orient": "x", "body_pose": "y"},
        {"poses": "x", "trans": None, "fps": 1},
        {"poses": {}, "trans": {}, "fps": {}},
    ):
        path.write_bytes(pickle.dumps(value))
        with pytest.raises(ValueError, match=r"odd\.pkl"):
            load_motion(path)
    for value in ([{"Rh": 1, "Th": 2, "poses": "x"}], [{"Rh": [], "Th": [], "poses": [[[]]]}]):
        (tmp_path / "odd.json").write_text(json.dumps(value))
        with pytest.raises(ValueError, match=r"odd\.json"):
            load_motion(tmp_path / "odd.json")


def test_files_that_could_be_two_formats_are_not_guessed(tmp_path, body):
    numbers = writers.smplx_numbers(2)
    folder = writers.xhumans(tmp_path, numbers)
    writers.smplerx(folder, numbers, (0, 1))
    with pytest.raises(ValueError, match=r"could be xhumans, smplerx; found.*format="):
        load_motion(folder, body=body)
    assert len(read(folder, body=body, format="xhumans")) == 2
    with pytest.raises(
        ValueError, match=r"not of the format bvh; looked for a text.*found a folder"
    ):
        load_motion(folder, format="bvh")
    with pytest.raises(ValueError, match="No motion format 'fbx'; there are amass, grab"):
        load_motion(folder, format="fbx")


def test_a_name_does_not_decide_the_format(tmp_path):
    arrays = {"poses": np.zeros((2, 165)), "trans": np.zeros((2, 3)), "betas": np.zeros(10)}
    with open(tmp_path / "walk.bvh", "wb") as file:
        np.savez(file, mocap_framerate=60, **arrays)
    assert read(tmp_path / "walk.bvh").fps == 60


# Writing


def some_motion(count=3, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "poses": 0.4 * rng.normal(size=(count, 55, 3)),
        "transl": rng.normal(size=(count, 3)),
        "joint_names": SMPLX_TREE.names,
        "fps": 30.0,
        "betas": rng.normal(size=10),
        "expression": rng.normal(size=(count, 10)),
        "gender": "male",
        "model": "smplx",
    }
    return Motion(**{**fields, **changes})


def same(one, other):
    """Equal as float32 numbers, all that bodies are posed with."""
    for name in ("poses", "transl", "betas", "expression"):
        np.testing.assert_array_equal(
            np.float32(getattr(one, name)), np.float32(getattr(other, name)), err_msg=name
        )


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "poses"])
def test_round_trips_are_exact_where_the_format_holds_everything(tmp_path, body, name):
    motion = some_motion(up="z" if name == "a.npz" else "y")
    with warnings.catch_warnings():
        if name != "a.npz":
            warnings.simplefilter("ignore", MotionNotice)
        path = save_motion(tmp_path / name, motion, body=body)
        back = load_motion(path, body=body)
    same(back, motion)
    assert back.fps == 30.0
    assert back.gender == ("unknown" if name == "a.npy" else "male")


def test_a_motion_is_turned_to_the_axes_of_the_format(tmp_path, body):
    motion = some_motion()
    back = load_motion(save_motion(tmp_path / "a.npz", motion, body=body))
    assert back.up == "z"
    np.testing.assert_allclose(posed(body, back.to_y_up(body)), posed(body, motion), atol=1e-5)
    with pytest.raises(ValueError, match="z-up and this motion is y-up"):
        save_motion(tmp_path / "b.npz", motion)


def test_losses_of_amass_archives_are_said(tmp_path):
    motion = some_motion(up="z", fps=25.0, gender="unknown", model="smplh", template="s1.ply")
    with pytest.warns(MotionNotice) as caught:
        path = save_motion(tmp_path / "a.npz", motion)
    said = " ".join(str(w.message) for w in caught)
    for words in ("written as neutral", "betas are of smplh", "s1.ply", "25 frames per second"):
        assert words in said
    with np.load(path) as data:
        assert data["gender"] == "neutral"
        assert data["fps"] == 25.0
        np.testing.assert_array_equal(data["betas"], 0)


@pytest.mark.parametrize("name", ["a.npy", "poses"])
def test_shapes_of_another_model_are_not_passed_on(tmp_path, body, name):
    with pytest.warns(MotionNotice) as caught:
        path = save_motion(tmp_path / name, some_motion(model="smplh"), body=body)
    said = " ".join(str(w.message) for w in caught)
    assert "betas are of smplh and have no meaning for the smplx body" in said
    assert not read(path, body=body).betas.any()


def test_a_pose_for_blender(tmp_path, body):
    """What the add-on takes: these names, `body_pose` of shape (1, 63), relative hands."""
    motion = some_motion(1)
    with pytest.warns(MotionNotice, match="no frame rate"):
        path = save_motion(tmp_path / "a.pkl", motion, body=body)
    raw = path.read_bytes()
    assert b"numpy._core" not in raw  # NumPy 1 has no such module
    data = pickle.loads(raw, encoding="latin1")
    assert {name: v.shape for name, v in data.items()} == {
        "transl": (1, 3), "global_orient": (1, 3), "body_pose": (1, 63), "jaw_pose": (1, 3),
        "leye_pose": (1, 3), "reye_pose": (1, 3), "left_hand_pose": (1, 45),
        "right_hand_pose": (1, 45), "betas": (1, 10), "expression": (1, 10),
    }  # fmt: skip
    hand = hands_to_relative(body, motion.poses[:, 40:], "right")
    np.testing.assert_allclose(data["right_hand_pose"].reshape(1, 15, 3), hand, atol=1e-6)
    with pytest.raises(ValueError, match=r"3 frames, and b\.pkl holds one.*motion\[10:11\]"):
        save_motion(tmp_path / "b.pkl", some_motion(), body=body)


def test_losses_of_pose_vectors_are_said(tmp_path, body):
    with pytest.warns(MotionNotice) as caught:
        save_motion(tmp_path / "a.npy", some_motion(betas=np.ones(16)), body=body)
    said = " ".join(str(w.message) for w in caught)
    assert "16 betas given, the format has 10" in said
    assert "neither frame rate nor gender" in said


def test_writing_needs_a_known_format_and_a_body(tmp_path):
    with pytest.raises(ValueError, match=r"nothing is written to '\.fbx' files. Use \.npz"):
        save_motion(tmp_path / "a.fbx", some_motion())
    with pytest.raises(ValueError, match="no format 'grab' to write; there are amass"):
        save_motion(tmp_path / "a.npz", some_motion(), format="grab")
    for name in ("a.bvh", "a.npy", "a.pkl", "poses"):
        with pytest.raises(ValueError, match="pass body=, whose"):
            save_motion(tmp_path / name, some_motion())
    (tmp_path / "poses").mkdir()
    with pytest.raises(FileExistsError, match="poses exists"):
        save_motion(tmp_path / "poses", some_motion(), body=object(), format="poses")
    assert [p.name for p in tmp_path.iterdir()] == ["poses"]


def test_nothing_is_left_of_a_write_that_fails(tmp_path, body, monkeypatch):
    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full_disk)
    monkeypatch.setattr("pathlib.Path.write_bytes", full_disk)
    monkeypatch.setattr("pathlib.Path.write_text", full_disk)
    for name in ("a.npy", "a.bvh", "poses"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MotionNotice)
            with pytest.raises(OSError, match="No space"):
                save_motion(tmp_path / name, some_motion(), body=body)
    assert list(tmp_path.iterdir()) == []
