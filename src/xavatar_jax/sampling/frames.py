"""Which frames to learn from."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from ..body import BodyParams, pose_groups
from ..kinematics import axis_angle_to_matrix


def varied_frames(params: BodyParams, count: int) -> Int[np.ndarray, " n"]:
    """Indices of `count` frames that differ most in pose and expression, in rising order.

    Greedy farthest-point choice from the first frame, over the rotations of all joints but the
    root (fingers count half, since there are many) and the expression. Deterministic.
    """
    total = len(params)
    if count >= total:
        return np.arange(total)
    rotations = np.asarray(axis_angle_to_matrix(params.pose))[:, 1:]
    groups = pose_groups(params.tree)
    share = np.ones(params.tree.num_joints)
    share[list(groups["left_hand_pose"] + groups["right_hand_pose"])] = 0.5
    features = (rotations * share[1:, None, None]).reshape(total, -1)
    features = np.concatenate([features, 0.3 * np.asarray(params.expression)], axis=1)
    chosen = [0]
    gap = ((features - features[0]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, ((features - features[chosen[-1]]) ** 2).sum(1))
    return np.sort(np.asarray(chosen))
