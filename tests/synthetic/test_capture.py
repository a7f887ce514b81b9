import os
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xavatar_jax.body import SMPLX_TREE, pose_body, rest_joints, rest_vertices
from xavatar_jax.files import CacheNotice
from xavatar_jax.motion import load_motion
from xavatar_jax.synthetic import (
    synthetic_body,
    synthetic_capture,
    synthetic_motions,
    write_synthetic_capture,
)
from xavatar_jax.synthetic.capture import write
from xavatar_jax.synthetic.capture.hand_shapes import HAND_SHAPES, TEST_SHAPES, left_hand_pose
from xavatar_jax.synthetic.capture.inverse_kinematics import two_bone
from xavatar_jax.synthetic.capture.limits import JOINT_LIMITS_DEG

NAMES = SMPLX_TREE.names
GROUPS = {"body": range(1, 22), "left": range(25, 40), "right": range(40, 55)}


@pytest.fixture(scope="module")
def motions(toy_body):
    return synthetic_motions(toy_body)


@pytest.fixture(scope="module")
def every_motion(motions):
    return {**motions["train"], **motions["test"]}


def test_two_bone_reaches_the_target():
    rng = np.random.default_rng(0)
    upper, lower, hinge = np.array([0.26, 0, -0.01]), np.array([0.25, 0.01, 0.02]), [0, -1.0, 0]
    root, pole = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    direction = rng.normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    target = root + direction * rng.uniform(0.1, 0.5, (50, 1))
    limb = two_bone(root, target, pole, upper, lower, np.array(hinge))
    end = root + limb.upper @ upper + np.einsum("nij,njk,k->ni", limb.upper, limb.lower, lower)
    np.testing.assert_allclose(end, target, atol=1e-9)
    # The elbow lies on the pole's side of the line to the target.
    elbow = limb.upper @ upper
    assert (np.einsum("ni,ni->n", elbow - (elbow * direction).sum(1, keepdims=True) * direction,
                      pole) > 0).all()  # fmt: skip


def test_fingers_bend_to_the_palm_and_spread_apart(toy_body):
    from xavatar_jax.body import BodyParams

    rest = dict(zip(NAMES, np.asarray(rest_joints(toy_body, np.zeros(10))), strict=True))

    def tips(shape, side):
        pose = np.zeros((55, 3))
        for name, vector in left_hand_pose(HAND_SHAPES[shape], rest).items():
            mirrored = vector if side == "left" else vector * [1, -1, -1]
            pose[NAMES.index(name.replace("left", side))] = mirrored
        joints = pose_body(toy_body, BodyParams.create(toy_body, pose=pose)).joints
        fingers = ("index", "middle", "ring", "pinky", "thumb")
        return {f: np.asarray(joints[NAMES.index(f"{side}_{f}3")]) for f in fingers}

    for side in ("left", "right"):
        flat, fist, spread = (tips(s, side) for s in ("flat", "fist", "spread"))
        for finger in ("index", "middle", "ring", "pinky"):
            assert fist[finger][1] < flat[finger][1] - 0.02, (side, finger)
            # Curled up: the last joint is back near the knuckle.
            assert abs(fist[finger][0]) < abs(flat[finger][0]) - 0.03, (side, finger)
        assert spread["index"][2] - spread["pinky"][2] > flat["index"][2] - flat["pinky"][2] + 0.02
        assert spread["thumb"][2] > flat["thumb"][2]
        for shape in (tips("pinch", side), tips("ok", side)):
            gap = np.linalg.norm(shape["thumb"] - shape["index"])
            assert gap < 0.5 * np.linalg.norm(flat["thumb"] - flat["index"])
        point = tips("point", side)
        np.testing.assert_allclose(point["index"], flat["index"], atol=0.01)
    left, right = tips("ok", "left"), tips("ok", "right")
    np.testing.assert_allclose(left["thumb"] * [-1, 1, 1], right["thumb"], atol=1e-5)


def test_counts_of_sequences_and_frames(motions):
    assert {part: len(named) for part, named in motions.items()} == {"train": 9, "test": 3}
    assert sum(map(len, motions["train"].values())) >= 1500
    assert sum(map(len, motions["test"].values())) >= 300


def test_every_frame_is_within_joint_limits(every_motion):
    for name, motion in every_motion.items():
        degrees = np.rad2deg(motion.poses)
        for j, joint in enumerate(NAMES):
            if joint == "pelvis":
                continue
            low, high = np.array(JOINT_LIMITS_DEG[joint]).T
            assert (degrees[:, j] >= low - 1e-6).all(), (name, joint)
            assert (degrees[:, j] <= high + 1e-6).all(), (name, joint)


def test_limits_are_rarely_what_stops_a_joint(every_motion):
    for name, motion in every_motion.items():
        limits = np.deg2rad([JOINT_LIMITS_DEG[joint] for joint in NAMES[1:]])
        held = np.isclose(motion.poses[:, 1:], limits[..., 0]) | np.isclose(
            motion.poses[:, 1:], limits[..., 1]
        )
        assert held.mean() < 0.005, name


def test_limits_are_mirror_images():
    for name, (x, y, z) in JOINT_LIMITS_DEG.items():
        if name.startswith("left_"):
            right = JOINT_LIMITS_DEG[name.replace("left", "right", 1)]
            assert right == (x, (-y[1], -y[0]), (-z[1], -z[0]))


def test_motion_is_smooth(every_motion):
    for name, motion in every_motion.items():
        turns = Rotation.from_rotvec(motion.poses[:-1].reshape(-1, 3)).inv() * Rotation.from_rotvec(
            motion.poses[1:].reshape(-1, 3)
        )
        step = turns.as_rotvec().reshape(len(motion) - 1, 55, 3)
        # Radians a second: a quick step.
        assert np.abs(step).max() * motion.fps < 14.0, (
            name,
            NAMES[np.abs(step).max((0, 2)).argmax()],
        )
        assert np.abs(np.diff(step, axis=0)).max() < 0.35, name
        assert np.linalg.norm(np.diff(motion.transl, axis=0), axis=1).max() < 0.07, name


def test_feet_are_on_the_floor(toy_body, every_motion):
    for name, motion in every_motion.items():
        for i in range(0, len(motion), 25):
            params = motion.to_params(toy_body)[i]
            lowest = float(pose_body(toy_body, params).vertices[:, 1].min())
            assert abs(lowest) < 0.002, (name, i)


def test_motion_is_the_same_again(toy_body, motions):
    again = synthetic_motions(toy_body)
    for name, motion in motions["test"].items():
        np.testing.assert_array_equal(again["test"][name].poses, motion.poses)
        np.testing.assert_array_equal(again["test"][name].transl, motion.transl)


def test_the_version_changes_with_the_motions(motions):
    """Cache entries are keyed by the version: record a new one here when the motions change."""
    # A sum, because compilers change the last bits.
    total = sum(
        np.abs(np.asarray(values, np.float64)).sum()
        for motion in {**motions["train"], **motions["test"]}.values()
        for values in (motion.poses, motion.transl, motion.expression)
    )
    assert write.SYNTHETIC_CAPTURE_VERSION == "1"
    np.testing.assert_allclose(total, 61325.12, rtol=1e-6)


def _lose_two(folder):
    for path in sorted(folder.glob("test/*.npz"))[:2]:
        path.unlink()


def _lose_all(folder):
    shutil.rmtree(folder)
    folder.mkdir()


def _swap(folder):
    one, two = sorted(folder.glob("train/*.npz"))[:2]
    shutil.copy(one, two)


@pytest.mark.parametrize("damage", [_lose_two, _lose_all, _swap])
def test_a_damaged_capture_in_the_cache_is_written_again(
    toy_body, motions, tmp_path, damage, monkeypatch
):
    monkeypatch.setattr(write, "synthetic_motions", lambda body: motions)
    first = synthetic_capture(tmp_path, toy_body)
    (folder,) = tmp_path.iterdir()
    damage(folder)
    with pytest.warns(CacheNotice, match="damaged cache entry, built again") as said:
        again = synthetic_capture(tmp_path, toy_body)
    assert len(said) == 1
    assert again.test.sequence_names == first.test.sequence_names
    np.testing.assert_array_equal(again.train.params.pose, first.train.params.pose)
    assert os.listdir(tmp_path) == [folder.name]


def _matrices(named, joints):
    poses = np.concatenate([motion.poses[:, list(joints)] for motion in named.values()])
    return Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(len(poses), -1, 9)


def nearest_deg(queries, others):
    """Root mean square joint angle from each pose to the nearest of others, degrees."""
    square = (queries**2).sum((1, 2))[:, None] + (others**2).sum((1, 2))[None]
    square = square - 2 * np.einsum("tjk,njk->tn", queries, others, optimize=True)
    mean = np.maximum(square, 0).min(1) / queries.shape[1]
    return np.rad2deg(2 * np.arcsin(np.sqrt(mean / 8)))  # |R - S| = sqrt(8) sin(angle / 2)


@pytest.mark.parametrize("group", GROUPS)
def test_held_out_poses_are_absent_from_training(motions, group):
    train, test = (_matrices(motions[part], GROUPS[group]) for part in ("train", "test"))
    distance = nearest_deg(test, train)
    assert np.median(distance) > 12.0
    assert (distance > 8.0).mean() > 0.8
    # Training poses have near neighbours, so that the distance means something.
    assert np.median(nearest_deg(train[::7], np.delete(train, np.s_[::7], 0))) < 2.0


def test_held_out_hand_shapes_are_not_among_those_of_training():
    from xavatar_jax.synthetic.capture.sequences import TRAIN_SEQUENCES

    for keys in TRAIN_SEQUENCES.values():
        for key in keys():
            assert not {key.left_hand, key.right_hand} & set(TEST_SHAPES)


def test_written_as_amass_and_read_as_grab(toy_body, tmp_path):
    capture = synthetic_capture(tmp_path, toy_body)
    (folder,) = tmp_path.iterdir()
    assert len(list(folder.glob("train/*_stageii.npz"))) == 9
    path = folder / "test/signs_and_piano_stageii.npz"
    with np.load(path, allow_pickle=False) as file:
        assert file["poses"].shape[1] == 165
        assert file["mocap_frame_rate"] == file["mocap_framerate"] == capture.fps
        assert str(file["gender"]) == capture.gender == "neutral"
    motion = load_motion(path)
    assert motion.up == "z"
    heights = np.asarray(pose_body(toy_body, motion.to_params(toy_body)[0]).vertices)[:, 2]
    assert abs(heights.min()) < 0.002
    assert heights.max() > 1.4
    assert list(capture.test.sequences) == sorted(capture.test.sequence_names)
    vertices = capture.test[5].vertices
    assert abs(vertices[:, 1].min()) < 0.002
    assert capture.notices == ()
    stamp = path.stat().st_mtime_ns
    synthetic_capture(tmp_path, toy_body)
    assert path.stat().st_mtime_ns == stamp  # cached
    with pytest.raises(FileExistsError, match="exists already"):
        write_synthetic_capture(folder, toy_body)


def test_an_interrupted_write_leaves_no_capture(toy_body, tmp_path, monkeypatch):
    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(write, "save_amass", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_synthetic_capture(tmp_path / "capture", toy_body)
    assert list(tmp_path.iterdir()) == []


def test_a_body_without_hands_is_refused(toy_body):
    import equinox as eqx

    from xavatar_jax.kinematics import KinematicTree

    tree = KinematicTree(tuple(f"j{i}" for i in range(55)), SMPLX_TREE.parents)
    other = eqx.tree_at(lambda b: b.template, toy_body, toy_body.template)
    object.__setattr__(other, "tree", tree)
    with pytest.raises(ValueError, match="lacks left_wrist"):
        synthetic_motions(other)


@pytest.fixture(scope="module")
def bundled_body():
    return synthetic_body()


@pytest.mark.slow
def test_the_person_is_not_the_mean_person(bundled_body):
    capture = synthetic_capture(body=bundled_body)
    own = np.asarray(rest_vertices(bundled_body, capture.betas))
    mean = np.asarray(rest_vertices(bundled_body, 0 * capture.betas))
    assert np.median(np.linalg.norm(own - mean, axis=1)) >= 0.010
    assert np.abs(capture.betas).max() < 3.0


def _capped(vertices, faces, chosen):
    """The part of a closed surface whose vertices are chosen, its holes closed by fans."""
    faces = faces[chosen[faces].all(1)]
    edges = {
        tuple(e) for e in np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    }
    following = {b: a for a, b in edges if (b, a) not in edges}
    points, fans, left = [vertices], [faces], set(following)
    count = len(vertices)
    while left:
        loop = [left.pop()]
        while following[loop[-1]] in left:
            loop.append(following[loop[-1]])
            left.discard(loop[-1])
        points.append(vertices[loop].mean(0, keepdims=True))
        fans.append(np.array([(a, b, count) for a, b in zip(loop, np.roll(loop, -1), strict=True)]))
        count += 1
    return np.concatenate(points), np.concatenate(fans).astype(np.int32)


@pytest.mark.slow
def test_forearms_and_hands_do_not_pass_through_the_body(bundled_body):
    import igl

    capture = synthetic_capture(body=bundled_body)
    weights = np.asarray(bundled_body.weights)

    def mass(*names):
        joints = {j for n in names for j in SMPLX_TREE.subtree(NAMES.index(n))}
        return weights[:, sorted(joints)].sum(1)

    rest_of_body = mass("left_shoulder", "right_shoulder") <= 0.5
    arms = {side: mass(f"{side}_elbow") > 0.6 for side in ("left", "right")}
    for frames in (capture.train, capture.test):
        for i in range(0, len(frames), 40):
            vertices = frames[i].vertices.astype(np.float64)
            faces = np.asarray(bundled_body.faces)
            for obstacle, sides in ((rest_of_body, ("left", "right")), (arms["left"], ("right",))):
                surface = _capped(vertices, faces, obstacle)
                for side in sides:
                    inside = igl.fast_winding_number(*surface, vertices[arms[side]]) > 0.5
                    assert inside.mean() < 0.02, (frames[i].source, side)
