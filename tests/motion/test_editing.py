"""Cutting, joining and smoothing, against what they do to turns about one axis."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from xavatar_jax.motion import Motion, MotionNotice, concat


def turning(angles, *, fps=30.0, axis=(0.0, 0.6, 0.8), **changes):
    """One joint that turns about an axis, and moves along x by its angle."""
    angles = np.asarray(angles, float)
    poses = Rotation.from_rotvec(np.outer(angles, axis)).as_rotvec()[:, None]
    fields = {"joint_names": ("pelvis",), "fps": fps, "transl": np.outer(angles, (1.0, 0, 0))}
    return Motion(poses=poses, **{**fields, **changes})


def angle_of(motion, axis=(0.0, 0.6, 0.8)):
    """Angles about the axis, without jumps of whole turns."""
    turn = Rotation.from_rotvec(motion.poses[:, 0])
    side = np.array([1.0, 0, 0])
    up = np.cross(axis, side)
    moved = turn.apply(side)
    return np.unwrap(np.arctan2(moved @ up, moved @ side))


def wobble(count=120, seed=0):
    time = np.arange(count) / 30
    noise = 0.05 * np.random.default_rng(seed).normal(size=count)
    return 3 + 0.8 * np.sin(2 * time) + noise  # passes half a turn to and fro


def test_smoothing_a_turn_is_smoothing_its_angle():
    """Away from the ends, the Gaussian filter of SciPy; no jump where the vector flips."""
    angles = wobble()
    motion = turning(angles)
    assert np.abs(np.diff(motion.poses[:, 0], axis=0)).max() > 2  # the vectors do jump
    smoothed = motion.smooth(0.1)
    expected = gaussian_filter1d(angles, 3.0, truncate=3.0)
    inner = slice(12, -12)
    found = angle_of(smoothed)
    error = (found - expected + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(error[inner]).max() < 1e-9
    np.testing.assert_allclose(smoothed.transl[inner, 0], expected[inner], atol=1e-9)
    np.testing.assert_allclose(smoothed.poses[[0, -1]], motion.poses[[0, -1]], atol=1e-12)


def test_smoothing_keeps_steady_motion():
    angles = np.linspace(-1, 5, 50)
    smoothed = turning(angles).smooth(0.2)
    np.testing.assert_allclose(angle_of(smoothed), angles, atol=1e-9)


def random_motion(count=30, seed=1):
    rng = np.random.default_rng(seed)
    walk = np.cumsum(0.2 * rng.normal(size=(count, 2, 3)), axis=0)
    poses = Rotation.from_rotvec(walk.reshape(-1, 3)).as_rotvec().reshape(count, 2, 3)
    return Motion(
        poses=poses, transl=walk[:, 0], joint_names=("a", "b"), fps=30.0,
        expression=rng.normal(size=(count, 3)),
    )  # fmt: skip


def test_smoothing_does_not_depend_on_the_axes():
    motion = random_motion()
    turn = Rotation.random(rng=3)
    poses = motion.poses.copy()
    poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    turned = Motion(poses=poses, transl=motion.transl, joint_names=("a", "b"), fps=30.0)
    one = turn * Rotation.from_rotvec(motion.smooth(0.1).poses[:, 0])
    other = Rotation.from_rotvec(turned.smooth(0.1).poses[:, 0])
    assert (one.inv() * other).magnitude().max() < 1e-9


def test_the_mean_of_rotations_balances_them():
    motion = random_motion()
    middle = 15
    smoothed = Rotation.from_rotvec(motion.smooth(0.1).poses[middle, 0])
    near = Rotation.from_rotvec(motion.poses[:, 0])
    weights = np.exp(-0.5 * ((np.arange(30) - middle) / 3.0) ** 2)
    weights *= np.abs(np.arange(30) - middle) <= 9
    left = weights @ (smoothed.inv() * near).as_rotvec() / weights.sum()
    assert np.abs(left).max() < 1e-6


def test_smoothing_some_joints_leaves_the_rest():
    motion = random_motion()
    smoothed = motion.smooth(0.1, joints=["b"])
    np.testing.assert_array_equal(smoothed.poses[:, 0], motion.poses[:, 0])
    np.testing.assert_array_equal(smoothed.poses[:, 1], motion.smooth(0.1).poses[:, 1])
    np.testing.assert_array_equal(smoothed.transl, motion.transl)
    assert motion.smooth(0.0) is motion
    for bad, message in ((-1.0, "zero or more"), (np.nan, "zero or more")):
        with pytest.raises(ValueError, match=message):
            motion.smooth(bad)
    with pytest.raises(ValueError, match="no joint tail to smooth"):
        motion.smooth(0.1, joints=["tail"])


def test_trimming_by_seconds():
    motion = turning(np.arange(31.0), fps=10.0)
    part = motion.trim(0.5, 1.2)
    np.testing.assert_array_equal(part.transl[:, 0], np.arange(5.0, 13.0))
    assert len(motion.trim()) == 31
    assert len(motion.trim(0.3)) == 28  # 0.3 seconds are not 3.0000000000000004 frames
    assert len(motion.trim(3.0)) == 1
    for start, end in ((2.0, 1.0), (4.0, None), (np.nan, None)):
        with pytest.raises(ValueError, match=r"no frame between .*runs from 0 to 3"):
            motion.trim(start, end)


def test_joining_without_a_blend():
    first, second = turning(np.arange(4.0)), turning(np.arange(10.0, 13.0))
    joined = concat([first, second])
    np.testing.assert_array_equal(joined.transl[:, 0], [0, 1, 2, 3, 10, 11, 12])
    assert joined.source == "motion + motion"
    assert concat([first]) is first
    followed = concat([first, second], follow=True)
    np.testing.assert_array_equal(followed.transl[:, 0], [0, 1, 2, 3, 3, 4, 5])


def test_joining_with_a_blend_mixes_along_the_arc():
    first, second = turning(np.full(6, 3.0), fps=10.0), turning(np.full(5, 3.4), fps=10.0)
    joined = concat([first, second, first], blend=0.3)
    assert len(joined) == 6 + 5 + 6 - 2 * 3
    weight = np.array([1, 2, 3]) / 4
    eased = weight**2 * (3 - 2 * weight)
    expected = 3 + 0.4 * np.concatenate(
        [np.zeros(3), eased, 1 - eased[:2], 1 - eased[2:], [0, 0, 0]]
    )
    # Five frames of the second are its three of the first blend and, from its last three, the next.
    middle = concat([first, second], blend=0.3)
    np.testing.assert_allclose(angle_of(middle)[:6], 3 + 0.4 * np.r_[0, 0, 0, eased], atol=1e-9)
    np.testing.assert_allclose(angle_of(middle)[6:], 3.4, atol=1e-9)
    np.testing.assert_allclose(middle.transl[:6, 0], expected[:6], atol=1e-9)


@pytest.mark.parametrize(("up", "height"), [("y", 1), ("z", 2)])
def test_following_keeps_the_height(up, height):
    rng = np.random.default_rng(0)
    first, second = (turning(np.zeros(9), transl=rng.normal(size=(9, 3)), up=up) for _ in "ab")
    joined = concat([first, second], blend=0.1, follow=True)
    ground = [k for k in range(3) if k != height]
    moved = joined.transl[9:] - second.transl[3:]
    np.testing.assert_allclose(moved[:, ground], moved[[0]][:, ground].repeat(6, 0), atol=1e-12)
    start = first.transl[6] - second.transl[0]
    np.testing.assert_allclose(moved[0, ground], start[ground], atol=1e-12)
    np.testing.assert_allclose(moved[:, height], 0, atol=1e-12)


def test_joined_motions_have_to_match():
    motion = turning(np.arange(6.0))
    with pytest.warns(MotionNotice, match="its shape differs from that of motion, which is used"):
        joined = concat([motion, turning(np.arange(6.0), betas=np.ones(10))])
    assert len(joined.betas) == 0
    assert len(concat([motion, turning(np.zeros(2), betas=np.zeros(10))])) == 8
    wide = turning(np.zeros(3), expression=np.ones((3, 5)))
    np.testing.assert_array_equal(concat([motion, wide]).expression[:6], np.zeros((6, 5)))
    other = turning(np.zeros(3), joint_names=("root",))
    for pair, options, message in (
        ((motion, other), {}, "has other joints than"),
        ((motion, turning(np.zeros(3), fps=60.0)), {}, "60 frames per second and .*resample one"),
        ((motion, turning(np.zeros(3), up="z")), {}, "is z-up and .* y-up; turn one"),
        ((motion, turning(np.zeros(3))), {"blend": 0.2}, "3 frames are fewer than the 6"),
        ((motion, motion), {"blend": -1.0}, "zero or more"),
        ((), {}, "No motions to join"),
    ):
        with pytest.raises(ValueError, match=message):
            concat(pair, **options)
