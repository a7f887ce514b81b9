"""Selection of varied training frames, and distances between poses."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ..body import BodyParams, pose_groups
from ..kinematics import axis_angle_to_matrix


def varied_frames(params: BodyParams, count: int) -> Int[np.ndarray, " n"]:
    """Sorted indices of `count` distinct frames that differ most in pose and expression.

    Greedy farthest-point selection from the first frame, over the expression and the rotations of
    all joints except the root; the many finger joints have half the weight. Deterministic.
    """
    from scipy.spatial.distance import cdist

    total = len(params)
    if count >= total:
        return np.arange(total)
    rotations = np.asarray(axis_angle_to_matrix(params.pose))[:, 1:]
    groups = pose_groups(params.tree)
    share = np.ones(params.tree.num_joints)
    share[list(groups["left_hand_pose"] + groups["right_hand_pose"])] = 0.5
    features = (rotations * share[1:, None, None]).reshape(total, -1)
    features = np.concatenate([features, 0.3 * np.asarray(params.expression)], axis=1)
    chosen: list[int] = []
    gap = np.full(total, np.inf)
    newest = 0
    while True:
        chosen.append(newest)
        if len(chosen) == count:
            return np.sort(np.asarray(chosen))
        # cdist allocates no array of the size of the features, which are large for long captures.
        gap = np.minimum(gap, cdist(features, features[newest : newest + 1], "sqeuclidean")[:, 0])
        gap[newest] = -np.inf  # not chosen again, even if all frames are equal
        newest = int(gap.argmax())


def pose_distance(params: BodyParams, known: BodyParams) -> Float[np.ndarray, " n"]:
    """Distance of each frame's pose to the nearest known pose, degrees.

    This is the root mean square angle between joint rotations, without the root.

    **Raises:** `ValueError` if the numbers of joints differ.
    """
    if params.tree.num_joints != known.tree.num_joints:
        raise ValueError(
            f"poses of {params.tree.num_joints} joints cannot be compared with poses of "
            f"{known.tree.num_joints}"
        )
    first, second = (
        np.asarray(axis_angle_to_matrix(p.pose), np.float64)[:, 1:].reshape(len(p), -1, 9)
        for p in (params, known)
    )
    nearest = np.empty(len(first))
    for k, rotation in enumerate(first):
        # The trace of the relative rotation, joint by joint.
        cosine = (np.einsum("njk,jk->nj", second, rotation) - 1) / 2
        angle = np.arccos(np.clip(cosine, -1, 1))
        nearest[k] = np.sqrt((angle**2).mean(1).min())
    return np.rad2deg(nearest)
