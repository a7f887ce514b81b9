"""BVH against forward kinematics written here, on our skeleton and on those of others."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
import writers
from helpers import reference_world
from scipy.spatial.transform import Rotation

from xavatar_jax.body import SMPLX_TREE, rest_joints
from xavatar_jax.motion import (
    JOINT_MAPS,
    Motion,
    MotionNotice,
    load_motion,
    save_bvh,
    save_motion,
)
from xavatar_jax.motion.joint_names import NEEDED, match_joints

ROOT = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
TURNS = ROOT[3:]
LIMBS = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
]


def quiet(function, *args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MotionNotice)
        return function(*args, **options)


def body_joints(body, motion):
    """Joints over time, one after another by the tree: turned about the pelvis, then moved."""
    params = quiet(motion.to_params, body)
    rest = np.asarray(rest_joints(body, params.betas[0]), np.float64)
    rotations = [Rotation.from_rotvec(pose).as_matrix() for pose in np.asarray(params.pose)]
    world = [reference_world(body.tree.parents, turns, rest)[:, :3, 3] for turns in rotations]
    return np.stack(world) + np.asarray(params.transl)[:, None]


def some_motion(body, count=4, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "poses": 0.4 * rng.normal(size=(count, body.num_joints, 3)),
        "transl": rng.normal(size=(count, 3)),
        "joint_names": body.tree.names,
        "fps": 30.0,
    }
    return Motion(**{**fields, **changes})


def turn(axis: str, degrees: float) -> np.ndarray:
    """A turn about one axis, written out."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rows = {
        "X": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "Y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "Z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(rows[axis])


def places(text: str) -> tuple[dict[str, np.ndarray], float]:
    """World places of all joints over time, `(T, 3)` by name, and seconds a frame."""
    head, motion = text.split("MOTION\n")
    names, offsets, parents, channels, stack = [], [], [], [], []
    for line in head.splitlines()[1:]:
        word, *rest = line.split()
        if word in ("ROOT", "JOINT", "End"):
            parents.append(stack[-1] if stack else -1)
            names.append(rest[0] if word != "End" else f"end of {names[stack[-1]]}")
            channels.append([])
            stack.append(len(names) - 1)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            offsets.append([float(x) for x in rest])
        elif word == "CHANNELS":
            channels[-1] = rest[1:]
    lines = motion.splitlines()
    result = {name: [] for name in names}
    for row in lines[2:]:
        values = iter(map(float, row.split()))
        world = []
        for parent, offset, names_here in zip(parents, offsets, channels, strict=True):
            local, place = np.eye(3), np.array(offset, float)
            for channel in names_here:
                value = next(values)
                if channel.endswith("position"):
                    place["XYZ".index(channel[0])] = value
                else:
                    local = local @ turn(channel[0], value)
            above, start = world[parent] if parent >= 0 else (np.eye(3), np.zeros(3))
            world.append((above @ local, start + above @ place))
        for name, (_, place) in zip(names, world, strict=True):
            result[name].append(place)
    return {n: np.array(p) for n, p in result.items()}, float(lines[1].split(":")[1])


def test_written_joints_stand_where_the_body_has_them(tmp_path, toy_body):
    betas = np.linspace(-1, 1, 10)
    motion = some_motion(toy_body, betas=betas)
    with pytest.warns(MotionNotice, match="not in the BVH file: betas"):
        path = save_motion(tmp_path / "a.bvh", motion, body=toy_body)
    found, interval = places(path.read_text())
    assert interval == pytest.approx(1 / 30, abs=1e-12)
    expected = body_joints(toy_body, motion)
    for joint, name in enumerate(toy_body.tree.names):
        np.testing.assert_allclose(found[name], expected[:, joint], atol=1e-5, err_msg=name)


def test_reading_what_was_written(tmp_path, toy_body):
    motion = some_motion(toy_body, count=6, up="z")
    back = load_motion(save_bvh(tmp_path / "a.bvh", motion, toy_body), body=toy_body)
    expected = motion.to_y_up(toy_body)
    assert (back.up, back.fps, back.notices) == ("y", 30.0, ())
    np.testing.assert_allclose(back.transl, expected.transl, atol=1e-7)
    np.testing.assert_allclose(back.poses, expected.poses, atol=1e-7)
    for name in ("poses", "transl"):
        one, other = (np.float32(getattr(m, name)) for m in (back, expected))
        # The same float32 numbers, but for the few that lie on the edge between two.
        assert (one != other).mean() < 0.01


def test_rotations_of_another_shape_come_back(tmp_path, bundled_body):
    betas = 2 * np.random.default_rng(0).normal(size=10)
    motion = some_motion(bundled_body, betas=betas)
    path = quiet(save_bvh, tmp_path / "a.bvh", motion, bundled_body)
    back = load_motion(path, body=bundled_body)
    np.testing.assert_allclose(back.poses, motion.poses, atol=1e-7)
    # The shape is lost; the pelvis stays where it was.
    pelvis = body_joints(bundled_body, back)[:, 0]
    np.testing.assert_allclose(pelvis, body_joints(bundled_body, motion)[:, 0], atol=1e-5)


def test_right_angles_are_written(tmp_path, toy_body):
    poses = np.zeros((2, 55, 3))
    poses[:, 5] = [np.pi / 2, 0, 0]
    motion = some_motion(toy_body, poses=poses, transl=np.zeros((2, 3)))
    back = load_motion(save_bvh(tmp_path / "a.bvh", motion, toy_body), body=toy_body)
    np.testing.assert_allclose(back.poses, poses, atol=1e-7)


def mixamo(arms=(60.0, -40.0, 0.0), prefix="mixamorig:"):
    """A skeleton in centimetres whose arms hang, with names and order of another program."""
    legs = ("UpLeg", (9.0, -6.0, 0.5)), ("Leg", (1.0, -42.0, 1.0)), ("Foot", (0.5, -41.0, -2.0))
    arm = (
        ("Shoulder", (6.0, 10.0, 0.0)), ("Arm", (12.0, 0.0, 0.0)),
        ("ForeArm", tuple(0.4 * a for a in arms)), ("Hand", tuple(0.38 * a for a in arms)),
        ("HandIndex1", (9.0, -3.0, 1.0)),
    )  # fmt: skip
    listed = [(0, "Hips", (0.0, 0.0, 0.0), ROOT), (1, "Spine", (0.0, 10.0, -1.0), TURNS)]
    listed += [(2, "Spine1", (0.0, 11.0, 0.0), TURNS), (3, "Spine2", (0.0, 12.0, 0.0), TURNS)]
    listed += [(4, "Neck", (0.0, 15.0, 1.0), TURNS), (5, "Head", (0.0, 9.0, 2.0), TURNS)]
    listed += [(6, "HeadTop_End", (0.0, 18.0, 0.0), TURNS), (7, "", (0.0, 1.0, 0.0), None)]
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        for chain, depth in ((arm, 4), (legs, 1)):
            for k, (name, (x, y, z)) in enumerate(chain):
                listed.append((depth + k, side + name, (sign * x, y, z), TURNS))
            listed.append((depth + len(chain), "", (0.0, -5.0, 0.0), None))
    joints = [(d, f"{prefix}{n}" if n else n, o, c) for d, n, o, c in listed]
    return joints, 6 + 3 * (sum(c is not None for *_, c in joints) - 1)


NAMES = {
    "pelvis": "Hips", "head": "Head", "neck": "Neck", "left_shoulder": "LeftArm",
    "left_elbow": "LeftForeArm", "left_wrist": "LeftHand", "left_hip": "LeftUpLeg",
    "left_knee": "LeftLeg", "left_ankle": "LeftFoot", "left_index1": "LeftHandIndex1",
}  # fmt: skip
NAMES |= {n.replace("left", "right"): v.replace("Left", "Right") for n, v in NAMES.items()}


def directions(place, pairs):
    bones = np.stack([place(far) - place(near) for near, far in pairs])
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


@pytest.mark.parametrize("prefix", ["mixamorig:", "", "mixamorig_"])
def test_limbs_point_where_those_of_another_skeleton_do(tmp_path, toy_body, prefix):
    joints, width = mixamo(prefix=prefix)
    rows = np.random.default_rng(0).uniform(-40, 40, (5, width))
    text = writers.bvh(joints, rows, interval=1 / 60)
    (tmp_path / "a.bvh").write_text(text)
    with pytest.warns(MotionNotice) as caught:
        motion = load_motion(tmp_path / "a.bvh", body=toy_body)
    said = " ".join(str(w.message) for w in caught)
    assert "joint map 'mixamo'" in said
    assert "HeadTop_End" in said
    assert "limbs at rest point up to" in said
    assert "fit the legs of the body" in said
    assert motion.fps == 60.0
    found, _ = places(text)
    posed, names = body_joints(toy_body, motion), toy_body.tree.names
    one = directions(lambda n: posed[:, names.index(n)], LIMBS)
    other = directions(lambda n: found[prefix + NAMES[n]], LIMBS)
    np.testing.assert_allclose(one, other, atol=1e-5)
    # The pelvis moves with the length of the legs, so that feet stay on the ground.
    rest = body_joints(toy_body, some_motion(toy_body, poses=np.zeros((4, 55, 3))))[0]
    own = sum(np.linalg.norm(rest[names.index(b)] - rest[names.index(a)]) for a, b in LIMBS[2:4])
    theirs = np.linalg.norm((1, -42, 1)) + np.linalg.norm((0.5, -41, -2))
    pelvis = posed[:, 0]
    np.testing.assert_allclose(pelvis, found[f"{prefix}Hips"] * own / theirs, rtol=0.01, atol=1e-3)


def test_a_skeleton_at_rest_gives_its_own_rest_pose(tmp_path, toy_body):
    joints, width = mixamo(arms=(60.0, -60.0, 0.0))
    (tmp_path / "a.bvh").write_text(writers.bvh(joints, np.zeros((2, width))))
    motion = quiet(load_motion, tmp_path / "a.bvh", body=toy_body)
    posed, names = body_joints(toy_body, motion), toy_body.tree.names
    arm = directions(lambda n: posed[:, names.index(n)], [("left_shoulder", "left_elbow")])[0]
    np.testing.assert_allclose(arm, np.tile(np.array([1, -1, 0]) / np.sqrt(2), (2, 1)), atol=1e-5)
    # Hands go on straight from the forearm, feet stay flat.
    np.testing.assert_allclose(motion.joint("left_wrist"), 0, atol=1e-7)
    leg = Rotation.from_rotvec(motion.joint("left_hip")) * Rotation.from_rotvec(
        motion.joint("left_knee")
    )
    foot = leg * Rotation.from_rotvec(motion.joint("left_ankle"))
    assert foot.magnitude().max() < 1e-6


def test_skeletons_with_z_up_are_turned(tmp_path, toy_body):
    joints, width = mixamo()
    rows = np.random.default_rng(1).uniform(-40, 40, (3, width))
    (tmp_path / "y.bvh").write_text(writers.bvh(joints, rows))
    upright = quiet(load_motion, tmp_path / "y.bvh", body=toy_body)
    # The same file by a program with z up, facing -y: (x, y, z) there is (x, -z, y).
    swap = {"X": ("X", 1), "Y": ("Z", 1), "Z": ("Y", -1)}
    turned, columns = [], []
    for depth, name, (x, y, z), channels in joints:
        names = None
        if channels is not None:
            columns += [swap[c[0]][1] for c in channels]
            names = tuple(swap[c[0]][0] + c[1:] for c in channels)
        turned.append((depth, name, (x, -z, y), names))
    (tmp_path / "z.bvh").write_text(writers.bvh(turned, rows * np.array(columns)))
    with pytest.warns(MotionNotice) as caught:
        motion = load_motion(tmp_path / "z.bvh", body=toy_body)
    assert any("not y-up facing +z; it was turned" in str(w.message) for w in caught)
    np.testing.assert_allclose(motion.poses, upright.poses, atol=1e-7)
    np.testing.assert_allclose(motion.transl, upright.transl, atol=1e-7)


def test_joint_maps_are_taken_and_checked(tmp_path, toy_body):
    joints, width = mixamo(prefix="")

    def odd_name(name):  # in no language
        return name[::-1].lower()

    odd = [(d, odd_name(n), o, c) for d, n, o, c in joints]
    path = tmp_path / "a.bvh"
    path.write_text(writers.bvh(odd, np.zeros((2, width))))
    with pytest.raises(ValueError, match=r"no joint for pelvis, head.*spih.*joint_map=") as error:
        load_motion(path, body=toy_body)
    assert "a.bvh" in str(error.value)
    chosen = {odd_name(theirs): ours for ours, theirs in NAMES.items()}
    motion = quiet(load_motion, path, body=toy_body, joint_map=chosen)
    assert len(motion) == 2
    for bad, message in (
        (chosen | {"liat": "head"}, "joint_map names liat"),
        (chosen | {odd_name("Neck"): "throat"}, "leads to throat"),
        ("daz", "No joint map 'daz'; there are smplx, mixamo, cmu, smpl"),
    ):
        with pytest.raises(ValueError, match=message):
            load_motion(path, body=toy_body, joint_map=bad)
    quiet(load_motion, path, body=toy_body, joint_map=chosen, scale=0.01)


def test_scale_and_frame_rate_can_be_said(tmp_path, toy_body):
    joints, width = mixamo()
    rows = np.zeros((2, width))
    rows[:, 1] = 95.0
    (tmp_path / "a.bvh").write_text(writers.bvh(joints, rows))
    motion = quiet(load_motion, tmp_path / "a.bvh", body=toy_body, scale=0.01, fps=24)
    assert motion.fps == 24
    assert body_joints(toy_body, motion)[0, 0, 1] == pytest.approx(0.95, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("MOTION", "MOTIONS"), "line .*is no BVH"),
        (lambda t: t.split("MOTION")[0], "not closed before MOTION"),
        (lambda t: t.replace("Frames: 2", "Frames: 3"), "Frames: 3, but 2 rows"),
        (lambda t: t.replace("Frame Time: 0.033333", "Frame Time: -0.1"), "Frame Time: -0.1"),
        (lambda t: t.replace("Frame Time: 0.033333", "Time: 1"), "expected 'Frame Time:'"),
        (lambda t: t.replace("CHANNELS 3", "CHANNELS 2", 1), "CHANNELS 2 Zrotation"),
        (lambda t: t.replace("Xrotation", "Wrotation", 1), "is not understood"),
        (lambda t: t[: t.rindex(" ")], "numbers, but the joints have"),
        (lambda t: t[: t.rindex(" ")] + " nan", "not finite in 1 of 2 frames"),
        (lambda t: t[: t.rindex(" ")] + " x", "expected a number"),
        (lambda t: t.replace("OFFSET 0.0 0.0 0.0", "OFFSET 0.0 up 0.0"), "expected a number"),
        (lambda t: t.replace("LeftLeg", "RightLeg"), "stands where none can"),
        (lambda t: t.replace("Frames: 2", "Frames: 0").split("0.033333")[0] + "0.1", "no frames"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, toy_body, change, message):
    joints, width = mixamo()
    (tmp_path / "a.bvh").write_text(change(writers.bvh(joints, np.zeros((2, width)))))
    with pytest.raises(ValueError, match=message) as error:
        load_motion(tmp_path / "a.bvh", body=toy_body)
    assert "a.bvh" in str(error.value)


def test_bvh_needs_a_body_with_those_joints(tmp_path, toy_body, family):
    joints, width = mixamo()
    (tmp_path / "a.bvh").write_text(writers.bvh(joints, np.zeros((2, width))))
    with pytest.raises(ValueError, match=r"Pass body=.*the body that is to move"):
        load_motion(tmp_path / "a.bvh")
    with pytest.raises(ValueError, match=r"the body \(mano.* has no pelvis, head"):
        load_motion(tmp_path / "a.bvh", body=family["mano"])
    odd = Motion(poses=np.zeros((1, 1, 3)), transl=np.zeros((1, 3)), joint_names=("x",), fps=1)
    with pytest.raises(ValueError, match="no joint of the motion is a joint of the body"):
        save_bvh(tmp_path / "b.bvh", odd, toy_body)


@pytest.mark.parametrize("name", JOINT_MAPS)
def test_every_map_leads_to_what_is_needed(name):
    targets = list(JOINT_MAPS[name].values())
    assert set(NEEDED) <= set(targets) <= set(SMPLX_TREE.names)
    assert len(set(targets)) == len(targets)
    for theirs, ours in JOINT_MAPS[name].items():
        side = {"l": "left", "r": "right"}.get(theirs[0].lower())
        if ours.startswith(("left", "right")):
            assert ours.startswith(str(side)), (theirs, ours)


_LIMB_NAMES = [
    f"{side}{name}"
    for side in ("Left", "Right")
    for name in ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
]


@pytest.mark.parametrize(
    ("title", "names", "first"),
    [
        # As CMU's captures have them, with a finger named as Mixamo names it.
        (
            "cmu",
            ["Hips", "LHipJoint", "RHipJoint", "LowerBack", "Spine", "Spine1", "Neck", "Neck1",
             "Head", "LeftFingerBase", "LeftHandIndex1", "LThumb", "RightFingerBase",
             "RightHandIndex1", "RThumb", *_LIMB_NAMES],
            "LowerBack",
        ),
        (
            "mixamo",
            ["Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", *_LIMB_NAMES,
             *(f"LeftHand{f}{k}" for f in ("Index", "Thumb") for k in (1, 2, 3))],
            "Spine",
        ),
    ],
)  # fmt: skip
def test_the_map_is_chosen_by_the_joints_of_the_body(title, names, first):
    found, joints = match_joints(tuple(names), None, "file.bvh")
    assert found == title
    assert names[joints["spine1"]] == first


# Skeletons of other programs: names, and rest poses that are no person

# Joint of SMPL-X, its parent, its place in a T-pose.
TPOSE = {
    "pelvis": (None, (0, 0.95, 0)), "spine1": ("pelvis", (0, 1.05, 0)),
    "spine3": ("spine1", (0, 1.27, 0)), "neck": ("spine3", (0, 1.46, 0)),
    "head": ("neck", (0, 1.57, 0)),
}  # fmt: skip
for _side, _sign in (("left", 1), ("right", -1)):
    for _name, _parent, (_x, _y, _z) in (
        ("collar", "spine3", (0.06, 1.39, 0)), ("shoulder", "collar", (0.19, 1.41, 0)),
        ("elbow", "shoulder", (0.46, 1.41, 0)), ("wrist", "elbow", (0.71, 1.41, 0)),
        ("hip", "pelvis", (0.1, 0.87, 0)), ("knee", "hip", (0.1, 0.47, 0.01)),
        ("ankle", "knee", (0.1, 0.08, 0)), ("foot", "ankle", (0.1, 0.02, 0.13)),
    ):  # fmt: skip
        _above = _parent if _parent in TPOSE else f"{_side}_{_parent}"
        TPOSE[f"{_side}_{_name}"] = (_above, (_sign * _x, _y, _z))
CHILDREN = {n: [c for c, (p, _) in TPOSE.items() if p == n] for n in TPOSE}


Y_UP = np.eye(3)
Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)  # from y-up


def along(axis):
    """Axes of every joint with one of them along its bone, as capture suits write them."""

    def axes(name):
        below = [c for c in CHILDREN[name] if "hip" not in c and "collar" not in c]
        here = np.array(TPOSE[name][1])
        bone = np.array(TPOSE[below[0]][1]) - here if below else here - TPOSE[TPOSE[name][0]][1]
        x = bone / np.linalg.norm(bone)
        z = np.array([1.0, 0, 0]) if abs(x[0]) < 0.9 else np.array([0, 0, 1.0])
        y = np.cross(z, x) / np.linalg.norm(np.cross(z, x))
        return np.roll(np.stack([x, y, np.cross(x, y)], axis=1), "xyz".index(axis), axis=1)

    return axes


def upright(name):
    return np.eye(3)


def suit(path, names, axes, world=Y_UP, count=5, seed=0, without=()):
    """A BVH file of random poses; returns the true places over time, y-up, by joint."""
    rng = np.random.default_rng(seed)
    swing = np.cumsum(rng.normal(0, 0.15, (count, len(TPOSE), 3)), axis=0)
    turned, place = {}, {}
    for k, (name, (parent, rest)) in enumerate(TPOSE.items()):
        local = Rotation.from_rotvec(swing[:, k]).as_matrix()
        if parent is None:
            turned[name], place[name] = local, np.tile(np.array(rest, float), (count, 1))
        else:
            turned[name] = turned[parent] @ local
            bone = np.array(rest) - TPOSE[parent][1]
            place[name] = place[parent] + turned[parent] @ bone
    kept = [n for n in TPOSE if n not in without]
    listed, columns = [], [100 * place["pelvis"] @ world.T]

    def add(name, depth):
        parent, rest = TPOSE[name]
        own = world @ turned[name] @ axes(name)
        if parent is None:
            offset, local = np.zeros(3), own
        else:
            offset = 100 * axes(parent).T @ (np.array(rest) - TPOSE[parent][1])
            local = np.swapaxes(world @ turned[parent] @ axes(parent), -1, -2) @ own
        columns.append(Rotation.from_matrix(local).as_euler("ZXY", degrees=True))
        listed.append(
            (depth, names[name], tuple(map(float, offset)), ROOT if parent is None else TURNS)
        )
        below = [c for c in CHILDREN[name] if c in kept]
        for child in below:
            add(child, depth + 1)
        if not below:
            listed.append((depth + 1, "", (0.0, 0.0, 0.0), None))

    add("pelvis", 0)
    path.write_text(writers.bvh(listed, np.concatenate(columns, axis=1)))
    return place


def worst_angle(body, motion, place, without=()):
    """Degrees between bones in the file and on the body, the largest of all bones."""
    posed, names = body_joints(body, motion), body.tree.names
    pairs = [(p, n) for n, (p, _) in TPOSE.items() if p and n not in without]
    own = ("pelvis", "spine1", "spine3", "neck")  # these differ between skeletons
    pairs = [(a, b) for a, b in pairs if a not in own and a[-5:] not in ("ollar", "ankle")]
    pairs += [("pelvis", "head"), ("right_hip", "left_hip"), ("right_shoulder", "left_shoulder")]
    one = directions(lambda n: posed[:, names.index(n)], pairs)
    other = directions(lambda n: place[n], pairs)
    return np.degrees(np.arccos(np.clip(np.sum(one * other, axis=-1), -1, 1))).max()


SMPLX_NAMES = {name: name for name in TPOSE}


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("root", ["along", "upright"])
@pytest.mark.parametrize("world", [Y_UP, Z_UP], ids=["y-up", "z-up"])
def test_bones_along_an_axis_of_their_joints(tmp_path, toy_body, axis, root, world):
    path = tmp_path / "suit.bvh"

    def axes(name):
        return np.eye(3) if name == "pelvis" and root == "upright" else along(axis)(name)

    place = suit(path, SMPLX_NAMES, axes, world)
    motion = quiet(load_motion, path, body=toy_body)
    assert worst_angle(toy_body, motion, place) < 12  # spines and hips differ in shape
    assert any("is not a person" in notice for notice in motion.notices)


@pytest.mark.parametrize("world", [Y_UP, Z_UP], ids=["y-up", "z-up"])
def test_upright_rest_poses_in_any_world(tmp_path, toy_body, world):
    """The rest pose stands along y; a rotation of the root turns the person to another axis."""
    path = tmp_path / "a.bvh"
    place = suit(path, SMPLX_NAMES, upright, world)
    with pytest.warns(MotionNotice) as caught:
        motion = load_motion(path, body=toy_body)
    said = " ".join(str(w.message) for w in caught)
    if world is Z_UP:  # nothing says whether the person lies
        assert worst_angle(toy_body, motion, {n: p @ Z_UP.T for n, p in place.items()}) < 12
    else:
        assert worst_angle(toy_body, motion, place) < 12
    assert "is not a person" not in said


def both(left):
    """Names of both sides from those of the left."""
    right = str.maketrans({"L": "R", "l": "r"})
    swapped = {
        k.replace("left", "right"): v.replace("Left", "Right").replace("left", "right")
        if "eft" in v else v.translate(right) for k, v in left.items()
    }  # fmt: skip
    return left | swapped


PARTS = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
TRUNK = ("pelvis", "spine1", "spine3", "neck", "head")
NAMINGS = {
    "by joint": ("Hips Chest Chest2 Neck Head",
        "LeftCollar LeftShoulder LeftElbow LeftWrist LeftHip LeftKnee LeftAnkle LeftToe"),
    "SMPL in words": ("Pelvis Spine1 Spine3 Neck Head",
        "Left_collar Left_shoulder Left_elbow Left_wrist Left_hip Left_knee Left_ankle Left_foot"),
    "game engine": ("Hips Spine UpperChest Neck Head", "LeftShoulder LeftUpperArm LeftLowerArm "
        "LeftHand LeftUpperLeg LeftLowerLeg LeftFoot LeftToes"),
    "with underscores": ("pelvis spine_01 spine_02 neck_01 head",
        "clavicle_l upperarm_l lowerarm_l hand_l thigh_l calf_l foot_l ball_l"),
    "with points": ("hips spine chest neck head", "shoulder.L upper_arm.L forearm.L hand.L "
        "thigh.L shin.L foot.L toe.L"),
    "small letters first": ("hip abdomen chest neck head",
        "lCollar lShldr lForeArm lHand lThigh lShin lFoot lToe"),
    "a character's name": ("Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Neck Bip01_Head",
        "Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand Bip01_L_Thigh "
        "Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0"),
    "sides at the end": ("Hips Spine Chest Neck Neck1", "Shoulder_L UpperArm_L LowerArm_L Hand_L "
        "UpperLeg_L LowerLeg_L Foot_L Toes_L"),
}  # fmt: skip


@pytest.mark.parametrize("without", [(), ("left_foot", "right_foot")], ids=["toes", "no toes"])
@pytest.mark.parametrize("naming", NAMINGS)
def test_names_are_read_as_words(tmp_path, toy_body, naming, without):
    trunk, limbs = (text.split() for text in NAMINGS[naming])
    left = {f"left_{part}": name for part, name in zip(PARTS, limbs, strict=True)}
    if naming == "small letters first":
        names = left | {k.replace("left", "right"): f"r{v[1:]}" for k, v in left.items()}
    elif "Left" in limbs[0]:
        names = both(left)
    else:
        swap = {"_l": "_r", ".L": ".R", "_L": "_R"}
        right = {
            k.replace("left", "right"): next(
                v.replace(a, b) for a, b in swap.items() if f"{a}_" in f"{v}_" or a in v
            )
            for k, v in left.items()
        }  # fmt: skip
        names = left | right
    names |= dict(zip(TRUNK, trunk, strict=True))
    path = tmp_path / "a.bvh"
    place = suit(path, names, upright, without=without)
    motion = quiet(load_motion, path, body=toy_body)
    assert worst_angle(toy_body, motion, place, without) < 12
    assert not any("are not used" in notice for notice in motion.notices)


def test_a_joint_map_may_be_a_file(tmp_path, toy_body):
    names = {name: f"bone{k}" for k, name in enumerate(TPOSE)}
    place = suit(tmp_path / "a.bvh", names, upright)
    with pytest.raises(ValueError, match="--joint-map FILE"):
        load_motion(tmp_path / "a.bvh", body=toy_body)
    table = tmp_path / "names.json"
    table.write_text(json.dumps({v: k for k, v in names.items()}))
    for given in (table, str(table)):
        motion = quiet(load_motion, tmp_path / "a.bvh", body=toy_body, joint_map=given)
        assert worst_angle(toy_body, motion, place) < 12
    for content, words in (
        ("[1]", "is no mapping"),
        ('{"bone0": 3}', "is no mapping"),
        ("{", "JSON"),
    ):
        table.write_text(content)
        with pytest.raises(ValueError, match=words):
            load_motion(tmp_path / "a.bvh", body=toy_body, joint_map=table)
