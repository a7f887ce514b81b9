"""Hands that do not move: what a body-only skeleton has in place of the scans'."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ...body import BodyModel, BodyParams, canonical_pose, pose_body
from ...geometry import face_areas
from ...kinematics import KinematicTree
from ..skeleton import body_only

_WRISTS = ("left_wrist", "right_wrist")


def moves_with_wrist(
    tree: KinematicTree, weights: Float[np.ndarray, "*n 3 J"]
) -> Bool[np.ndarray, "*n"]:
    """Triangles that a wrist moves most, by the weights of their corners."""
    return weights[..., tree.indices(*_WRISTS)].sum(-1).mean(-1) > 0.5


def static_hands(
    whole: BodyModel, params: BodyParams, betas: Any
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, " n"]] | None:
    """Canonical triangles of the person's hands, and the area of each, as a share of all.

    Fingers have the mean pose of `params`, batched. None for a body without wrists.
    """
    cut = body_only(whole)
    faces = np.asarray(whole.faces)
    on_hand = moves_with_wrist(cut.tree, np.asarray(cut.weights)[faces])
    if not on_hand.any():
        return None
    pose = np.array(canonical_pose(whole))
    for wrist in whole.tree.indices(*_WRISTS):
        fingers = [j for j in whole.tree.subtree(wrist) if j != wrist]
        pose[fingers] = np.asarray(params.pose).mean(0)[fingers]
    own = BodyParams.create(whole, pose=pose, betas=betas)
    vertices = np.asarray(pose_body(whole, own).vertices, np.float64)
    area = face_areas(vertices, faces[on_hand])
    return vertices[faces[on_hand]], area / area.sum()
