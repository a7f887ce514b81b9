"""Joint names and trees of the SMPL family."""

from __future__ import annotations

from ..kinematics import KinematicTree

_BODY = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck"),
    *("left_collar", "right_collar", "head", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
_BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
FINGERS = ("index", "middle", "pinky", "ring", "thumb")


def _hand_names(side: str) -> tuple[str, ...]:
    return tuple(f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3))


def _hand_parents(wrist: int, first: int) -> tuple[int, ...]:
    return tuple(wrist if k % 3 == 0 else first + k - 1 for k in range(15))


SMPLX_TREE = KinematicTree(
    (*_BODY, "jaw", "left_eye", "right_eye", *_hand_names("left"), *_hand_names("right")),
    (*_BODY_PARENTS, 15, 15, 15, *_hand_parents(20, 25), *_hand_parents(21, 40)),
)
"""The 55 joints of SMPL-X: body, jaw, eyes and two hands."""
SMPLH_TREE = KinematicTree(
    (*_BODY, *_hand_names("left"), *_hand_names("right")),
    (*_BODY_PARENTS, *_hand_parents(20, 22), *_hand_parents(21, 37)),
)
"""The 52 joints of SMPL-H: body and two hands."""
SMPL_TREE = KinematicTree((*_BODY, "left_hand", "right_hand"), (*_BODY_PARENTS, 20, 21))
"""The 24 joints of SMPL: body and one joint per hand."""


def mano_tree(side: str) -> KinematicTree:
    """The 16 joints of one MANO hand; `side` is "left" or "right"."""
    return KinematicTree((f"{side}_wrist", *_hand_names(side)), (-1, *_hand_parents(0, 1)))


def pose_groups(tree: KinematicTree) -> dict[str, tuple[int, ...]]:
    """Joint indices of each of SMPL-X's pose parameters, found by joint name.

    Groups of joints that the tree lacks are empty. Joints of no other group belong to `body_pose`.
    """

    def fingers(side: str) -> tuple[int, ...]:
        stems = [f"{side}_{finger}" for finger in FINGERS]
        return tuple(j for j, name in enumerate(tree.names) if name[:-1] in stems)

    groups = {
        "global_orient": (0,),
        "jaw_pose": tree.indices("jaw"),
        "leye_pose": tree.indices("left_eye"),
        "reye_pose": tree.indices("right_eye"),
        "left_hand_pose": fingers("left"),
        "right_hand_pose": fingers("right"),
    }
    taken = {joint for group in groups.values() for joint in group}
    groups["body_pose"] = tuple(j for j in range(tree.num_joints) if j not in taken)
    return groups
