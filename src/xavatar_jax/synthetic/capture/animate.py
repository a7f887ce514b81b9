"""Smooth motion of a body from key poses."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...body import BodyModel, rest_joints
from ...motion import Motion
from .hand_shapes import HAND_SHAPES, left_hand_pose
from .inverse_kinematics import (
    rotation_about,
    to_matrix,
    to_rotvec,
    two_bone,
    unit,
)
from .keys import Arm, Key
from .limits import joint_limits

_X, _Y, _Z = np.eye(3)
_MIRROR = np.array([-1.0, 1.0, 1.0])  # for positions; axis-angle vectors take the opposite signs
_MIRROR_ROTATION = -_MIRROR
_STANDING_BEND_M = 0.012  # knees are never quite straight
_NOISE_DEG = {"spine": 0.5, "neck": 0.8, "head": 1.0, "shoulder": 1.2, "elbow": 1.5, "wrist": 1.8}
_FINGER_NOISE_DEG = 2.0
_ARM = ("collar", "shoulder", "elbow", "wrist")


def animate(
    keys: Sequence[Key], body: BodyModel, betas: Float[np.ndarray, " S"], *, fps: float, seed: int
) -> Motion:
    """Smooth motion through key poses, y-up, with the feet at the positions of the keys.

    Joint angles of arms, hands, spine and head are monotone cubic interpolations of the keys,
    which never overshoot. Legs are solved for every frame, so that planted feet do not slide.
    Band-limited noise is added.

    Args:
        keys: key poses in temporal order.
        body: provides the skeleton, with the joints of SMPL-X.
        betas: shape of the person.
        fps: frames per second.
        seed: random seed of the noise.
    """
    names = body.tree.names
    joints = dict(
        zip(names, np.asarray(rest_joints(body, jnp.asarray(betas)), np.float64), strict=True)
    )
    times = np.array([key.time for key in keys])
    frames = np.arange(0.0, times[-1] + 1e-9, 1.0 / fps)
    noise = _Noise(frames, np.random.default_rng(seed))
    posed = _upper_body(keys, joints, names)
    poses = {name: _smooth(times, values, frames) for name, values in posed.items()}
    _add_noise(poses, noise)
    root, transl = _lower_body(keys, joints, frames, noise, poses)
    poses["pelvis"] = root
    expression = _face(keys, frames, noise, poses, body.num_expression)
    pose = np.stack([poses.get(name, np.zeros((len(frames), 3))) for name in names], axis=1)
    low, high = joint_limits(names)
    return Motion(
        poses=np.clip(pose, low, high),
        transl=transl,
        joint_names=names,
        fps=fps,
        betas=betas,
        expression=expression,
        up="y",
    )


class _Noise:
    """Band-limited noise: sums of a few slow sine waves, deterministic for a seed."""

    def __init__(self, times: np.ndarray, rng: np.random.Generator):
        self._times, self._rng = times, rng

    def __call__(self, size: int, low_hz: float = 0.15, high_hz: float = 0.9) -> np.ndarray:
        """Noise (T, size) of unit variance."""
        waves = 5
        frequency = self._rng.uniform(low_hz, high_hz, (waves, 1, size))
        phase = self._rng.uniform(0, 2 * np.pi, (waves, 1, size))
        wave = np.sin(2 * np.pi * frequency * self._times[None, :, None] + phase)
        return wave.sum(0) / np.sqrt(waves / 2)


def _smooth(times: np.ndarray, values: np.ndarray, frames: np.ndarray) -> np.ndarray:
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(times, values, axis=0)(np.clip(frames, times[0], times[-1]))


def _upper_body(
    keys: Sequence[Key], joints: dict[str, np.ndarray], names: Sequence[str]
) -> dict[str, np.ndarray]:
    """Axis-angle vectors (K, 3) at the keys, by joint: spine, neck, head, eyes, arms, fingers."""
    poses: dict[str, np.ndarray] = {}
    torso = np.deg2rad([key.torso for key in keys])
    bend = np.stack([torso[:, 0], torso[:, 2], -torso[:, 1]], axis=1) / 3
    poses |= dict.fromkeys(("spine1", "spine2", "spine3"), bend)
    gaze = np.deg2rad([key.gaze for key in keys])
    turn = np.stack([-gaze[:, 1], gaze[:, 0], -gaze[:, 2]], axis=1)
    poses |= {"neck": 0.4 * turn, "head": 0.5 * turn}
    eyes = np.clip(0.25 * turn * [1, 1, 0], -0.35, 0.35)
    poses |= {"left_eye": eyes, "right_eye": eyes}
    for side in ("left", "right"):
        mirrored = side == "right"
        arm = _arm(np.array([getattr(key, side) for key in keys], np.float64), joints)
        hand = [left_hand_pose(HAND_SHAPES[getattr(key, f"{side}_hand")], joints) for key in keys]
        arm |= {name: np.stack([pose[name] for pose in hand]) for name in hand[0]}
        for name, values in arm.items():
            name = name.replace("left", "right", 1) if mirrored else name
            poses[name] = _unwrap(values * _MIRROR_ROTATION if mirrored else values)
    low, high = joint_limits(names)
    for j, name in enumerate(names):
        if name in poses:
            poses[name] = np.clip(poses[name], low[j], high[j])
    return poses


def _arm(arms: np.ndarray, joints: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Left arm joints, (K, 3) by name, from `Arm` rows (K, 7). The body is symmetric."""
    azimuth, height, extent, elbow, palm, wrist_bend, tilt = np.deg2rad(arms).T
    extent = arms[:, Arm._fields.index("extent")]
    direction = np.stack(
        [np.sin(azimuth) * np.cos(height), np.sin(height), np.cos(azimuth) * np.cos(height)], 1
    )
    # The shoulder girdle follows the arm: up when it is raised, forwards when it reaches out.
    raised = np.clip((np.rad2deg(height) + 20) / 110, -0.35, 1.0)
    forward = np.clip(np.cos(height) * np.cos(azimuth) * (extent - 0.4), -0.2, 0.6)
    collar = np.stack([0 * raised, -0.35 * forward, np.deg2rad(24) * raised], axis=1)
    collar_rotation = to_matrix(collar)
    to_shoulder = joints["left_shoulder"] - joints["left_collar"]
    upper, lower = (
        joints["left_elbow"] - joints["left_shoulder"],
        joints["left_wrist"] - joints["left_elbow"],
    )
    length = np.linalg.norm(upper) + np.linalg.norm(lower)
    shoulder = collar_rotation @ to_shoulder
    pole = _pole(direction, elbow)
    limb = two_bone(
        shoulder,
        shoulder + extent[:, None] * length * direction,
        pole,
        upper,
        lower,
        -_Y,
    )
    shoulder_local = np.swapaxes(collar_rotation, -1, -2) @ limb.upper
    # The twist of the forearm is shared equally by elbow and wrist.
    half = rotation_about(np.broadcast_to(lower, pole.shape), 0.5 * palm)
    wrist = to_matrix(np.stack([0 * tilt, -tilt, -wrist_bend], axis=1))
    return {
        "left_collar": collar,
        "left_shoulder": to_rotvec(shoulder_local),
        "left_elbow": to_rotvec(limb.lower @ half),
        "left_wrist": to_rotvec(half @ wrist),
    }


def _pole(direction: np.ndarray, swivel: np.ndarray) -> np.ndarray:
    """Direction of the left elbow: down, out and slightly back, rotated about the arm's line."""
    natural = np.broadcast_to(np.array([0.45, -1.0, -0.35]), direction.shape)
    # For an arm that hangs down, the elbow points back.
    hanging = np.clip(-direction[:, 1:2] - 0.6, 0, 1) / 0.4
    natural = (1 - hanging) * natural + hanging * np.array([0.35, 0.0, -1.0])
    side = unit(natural - (natural * direction).sum(1, keepdims=True) * direction)
    return np.einsum("kab,kb->ka", rotation_about(direction, -swivel), side)


def _unwrap(rotvec: np.ndarray) -> np.ndarray:
    """The same rotations as axis-angle vectors without jumps of a full turn."""
    out = rotvec.copy()
    for i in range(1, len(out)):
        angle = np.linalg.norm(out[i])
        if angle < 1e-6:
            continue
        other = out[i] * (1 - 2 * np.pi / angle)
        if np.linalg.norm(other - out[i - 1]) < np.linalg.norm(out[i] - out[i - 1]):
            out[i] = other
    return out


def _add_noise(poses: dict[str, np.ndarray], noise: _Noise) -> None:
    for name in poses:
        if name.startswith(("left_eye", "right_eye")):
            poses[name] = poses[name] + np.deg2rad(1.2) * noise(3, 0.3, 1.5) * [1, 1, 0]
            continue
        part = name.removeprefix("left_").removeprefix("right_")
        scale = next((s for key, s in _NOISE_DEG.items() if part.startswith(key)), None)
        if scale is not None:
            poses[name] = poses[name] + np.deg2rad(scale) * noise(3)
        elif part[-1] in "123":
            # Noise only along the flexion of a finger, not across it.
            bend = poses[name]
            size = np.linalg.norm(bend, axis=1, keepdims=True)
            poses[name] = bend + bend / np.maximum(size, 0.15) * np.deg2rad(
                _FINGER_NOISE_DEG
            ) * noise(1)


def _lower_body(
    keys: Sequence[Key],
    joints: dict[str, np.ndarray],
    frames: np.ndarray,
    noise: _Noise,
    poses: dict[str, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Root rotation and translation (T, 3); leg joints are added to `poses`."""
    times = np.array([key.time for key in keys])
    pelvis = _smooth(times, np.array([key.pelvis for key in keys], np.float64), frames)
    sway = noise(6, 0.1, 0.4) * [0.006, 0.0, 0.005, 0.8, 0.5, 0.4]
    pelvis = pelvis + sway
    place, angle = pelvis[:, :3], np.deg2rad(pelvis[:, 3:])
    root = (
        rotation_about(_Y, angle[:, 0])
        @ rotation_about(_X, angle[:, 1])
        @ rotation_about(_Z, -angle[:, 2])
    )
    origin = joints["pelvis"] - [0.0, _STANDING_BEND_M, 0.0]
    position = origin + place
    for side, sign in (("left", 1.0), ("right", -1.0)):
        feet = np.array([getattr(key, f"{side}_foot") for key in keys], np.float64)
        foot = _smooth(times, feet, frames)
        poses |= _leg(side, sign, foot, root, position, joints)
    return to_rotvec(root), position - joints["pelvis"]


def _leg(
    side: str,
    sign: float,
    foot: np.ndarray,
    root: np.ndarray,
    position: np.ndarray,
    joints: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    hip, knee, ankle, ball = (joints[f"{side}_{n}"] for n in ("hip", "knee", "ankle", "foot"))
    left, up, forward, yaw, heel, out = foot.T
    yaw, heel, out = np.deg2rad(yaw), np.deg2rad(heel), np.deg2rad(out)
    turn = rotation_about(_Y, yaw)
    lifted = turn @ rotation_about(_X, heel)
    # `left` and `forward` place the ball of the foot, which at rest is in front of the ankle.
    target_ball = np.stack([left, ball[1] + up, forward + ball[2]], axis=1)
    target = target_ball + lifted @ (ankle - ball)
    start = position + root @ (hip - joints["pelvis"])
    facing = rotation_about(_Y, yaw + sign * out) @ _Z
    pole = unit(root @ _Z + 1.5 * facing)
    limb = two_bone(start, target, pole, knee - hip, ankle - knee, _X)
    ankle_global = limb.upper @ limb.lower
    return {
        f"{side}_hip": to_rotvec(np.swapaxes(root, -1, -2) @ limb.upper),
        f"{side}_knee": to_rotvec(limb.lower),
        f"{side}_ankle": to_rotvec(np.swapaxes(ankle_global, -1, -2) @ lifted),
        # Toes stay flat while only the heel is raised, and straighten as the foot leaves the floor.
        f"{side}_foot": -np.clip(heel, 0, None)[:, None]
        * _X
        * np.clip(1 - up / 0.05, 0, 1)[:, None],
    }


def _face(
    keys: Sequence[Key],
    frames: np.ndarray,
    noise: _Noise,
    poses: dict[str, np.ndarray],
    count: int,
) -> np.ndarray:
    """Expression (T, E), and the jaw in `poses`."""
    times = np.array([key.time for key in keys])
    size = min(count, 10)
    values = np.array([[key.face.get(i, 0.0) for i in range(size)] for key in keys])
    expression = _smooth(times, values, frames) + 0.12 * noise(size, 0.2, 0.8)
    jaw, talk = _smooth(times, np.array([[key.jaw, key.talk] for key in keys]), frames).T
    syllables = np.clip(0.5 + 0.5 * noise(1, 2.0, 4.5)[:, 0], 0, 1.6)
    opening = jaw + 9.0 * talk * syllables + 0.4 * noise(1)[:, 0]
    side = 0.5 * noise(2, 0.3, 1.0)
    poses["jaw"] = np.deg2rad(np.stack([np.clip(opening, 0, 26), side[:, 0], side[:, 1]], axis=1))
    expression = expression + 0.5 * talk[:, None] * noise(size, 0.8, 2.5)
    return np.clip(expression, -2.5, 2.5)
