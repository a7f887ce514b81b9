"""Bodies that are driven as SMPL is: no fingers, jaw, eyes or expression."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ..body import BodyModel, BodyParams, pose_groups
from ..frames import Frames
from ..kinematics import KinematicTree

_ENDS = ("left_wrist", "right_wrist", "head")  # what is below them moves with them
_GROUPS = ("left_hand_pose", "right_hand_pose", "jaw_pose", "leye_pose", "reye_pose")


def kept_joints(tree: KinematicTree) -> tuple[int, ...]:
    """Joints of the body alone, in their order: none below a wrist or the head, no jaw, no eye.

    A tree without these names keeps all of its joints.
    """
    dropped = {j for name in _GROUPS for j in pose_groups(tree)[name]}
    for end in tree.indices(*_ENDS):
        dropped |= set(tree.subtree(end)) - {end}
    dropped |= {k for j in dropped for k in tree.subtree(j)}
    return tuple(j for j in range(tree.num_joints) if j not in dropped)


def body_only(body: BodyModel) -> BodyModel:
    """The same surface on the joints of the body alone, without expression.

    The skinning weights of a joint that is dropped go to the nearest one above it that is kept, so
    that hands move with their wrists. Vertices are those of the whole body wherever the dropped
    joints do not turn and the expression is zero. Part labels stay.

    **Raises:** `ValueError` if nothing but the root is left, as of a hand.
    """
    kept = kept_joints(body.tree)
    if len(kept) < 2:
        raise ValueError(
            f"the body ({body.source.describe()}) has no joints but the root once hands and face "
            "are left out: a body-only skeleton needs a body"
        )
    rows = np.asarray(kept)
    # The correctives of a joint are nine columns; the root has none.
    columns = (9 * (rows[1:, None] - 1) + np.arange(9)).ravel()
    dtype = body.weights.dtype
    digest = hashlib.sha256(f"{body.source.checksum} body only".encode())
    return replace(
        body,
        expression_dirs=body.expression_dirs[..., :0],
        pose_dirs=body.pose_dirs[..., columns],
        joint_regressor=body.joint_regressor[rows],
        joint_template=body.joint_template[rows],
        joint_shape_dirs=body.joint_shape_dirs[rows],
        joint_expression_dirs=body.joint_expression_dirs[rows][..., :0],
        weights=jnp.asarray(np.asarray(body.weights) @ _carried(body.tree, kept), dtype),
        hand_mean=body.hand_mean[rows],
        hand_components={},
        tree=_cut(body.tree, kept),
        source=replace(body.source, checksum=digest.hexdigest()),
    )


def body_only_params(body: BodyModel, params: BodyParams) -> BodyParams:
    """Parameters of `body_only(whole)`, here `body`, for those of the whole body.

    **Raises:** `ValueError` if the body is not the one that the parameters' tree gives.
    """
    kept = kept_joints(params.tree)
    if _cut(params.tree, kept) != body.tree:
        raise ValueError(
            f"params are for a tree of {params.tree.num_joints} joints, of which {len(kept)} stay; "
            f"the body ({body.source.describe()}) has {body.num_joints} others"
        )
    return BodyParams(
        pose=params.pose[..., np.asarray(kept), :],
        betas=params.betas,
        expression=params.expression[..., :0],
        transl=params.transl,
        tree=body.tree,
    )


def body_only_frames(body: BodyModel, frames: Frames) -> Frames:
    """The same meshes with the parameters of `body`, a body-only one."""
    return frames.with_params(body_only_params(body, frames.params), body)


def _cut(tree: KinematicTree, kept: tuple[int, ...]) -> KinematicTree:
    place = {joint: k for k, joint in enumerate(kept)}
    return KinematicTree(
        tuple(tree.names[j] for j in kept), tuple(place.get(tree.parents[j], -1) for j in kept)
    )


def _carried(tree: KinematicTree, kept: tuple[int, ...]) -> np.ndarray:
    """`(J, kept)` ones: where the weight of each joint goes."""
    carried = np.zeros((tree.num_joints, len(kept)))
    for joint in range(tree.num_joints):
        above = joint
        while above not in kept:
            above = tree.parents[above]
        carried[joint, kept.index(above)] = 1
    return carried
