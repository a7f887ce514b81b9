"""Avatars that move as SMPL does, without fingers, jaw, eyes or expression, on a whole body."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt8

from ..body import BodyModel, BodyParams, pose_groups, with_betas
from ..frames import Frames, posed_vertices
from ..kinematics import KinematicTree
from ..meshing import Mesh
from .animate import Animation, MotionLike, animate
from .files import save_avatar
from .implicit import Avatar
from .protocol import AbstractRestSurface, Mode
from .rigging import GlbExport, Motions, export_glb, export_weights

_ENDS = ("left_wrist", "right_wrist", "head")  # joints below these move with them
_GROUPS = ("left_hand_pose", "right_hand_pose", "jaw_pose", "leye_pose", "reye_pose")


class BodyOnlySurface(AbstractRestSurface):
    """The rest surface of an avatar on a body-only skeleton, for the joints of the whole body."""

    faces: Int[np.ndarray, "F 3"]
    vertices: Float[Array, "3 V"]
    weights: Float[Array, "J V"]
    colors: UInt8[np.ndarray, "V C"] | None
    own: AbstractRestSurface
    body: BodyModel
    num_expression: int = eqx.field(static=True)

    def condition(self, params: BodyParams) -> PyTree[Array]:
        return self.own.condition(body_only_params(self.body, params))

    def under(self, condition: PyTree[Array]) -> Float[Array, "3 V"]:
        return self.own.under(condition)


@dataclass(frozen=True, eq=False)
class BodyOnlyAvatar:
    """An avatar on a body-only skeleton, driven with the parameters of the whole body.

    - `body`: the whole body.
    - `avatar`: the avatar on `body_only(body)`. Its own methods take that body's parameters.
    """

    body: BodyModel
    avatar: Avatar

    @property
    def betas(self) -> Float[np.ndarray, " S"]:
        """The shape of the person."""
        return self.avatar.betas

    @property
    def steps(self) -> int:
        """Training steps that the model has seen."""
        return self.avatar.steps

    @property
    def method(self) -> str:
        """The method that trained the model."""
        return self.avatar.method

    @property
    def options(self) -> Mapping[str, Any]:
        """The method's options as plain values."""
        return self.avatar.options

    @property
    def rest(self) -> AbstractRestSurface:
        """The surface at rest, with weights over all joints; those of hands and face are zero."""
        return self._rest

    @cached_property
    def _rest(self) -> AbstractRestSurface:
        own = self.avatar.rest
        rows = jnp.asarray(kept_joints(self.body.tree))
        weights = jnp.zeros((self.body.num_joints, own.weights.shape[1]), own.weights.dtype)
        weights = weights.at[rows].set(own.weights)
        return BodyOnlySurface(
            faces=own.faces,
            vertices=own.vertices,
            weights=weights,
            colors=own.colors,
            own=own,
            body=self.avatar.body,
            num_expression=0,
        )

    def mesh(self, params: BodyParams, *, mode: Mode = "fast", **options: Any) -> Mesh:
        """The posed surface of one frame of the whole body, metres: see `Avatar.mesh`."""
        return self.avatar.mesh(body_only_params(self.avatar.body, params), mode=mode, **options)

    def surface(self, params: BodyParams, *, mode: Mode = "fast") -> Mesh:
        """`mesh` with the default cells."""
        return self.mesh(params, mode=mode)

    def posed_template(self, params: BodyParams) -> Float[np.ndarray, "V 3"]:
        """Vertices of the whole body in this pose and the person's shape, metres."""
        return np.asarray(posed_vertices(self.body, with_betas(params, self.betas)), np.float64)

    def canonical_mesh(self, **options: Any) -> Mesh:
        """The surface in canonical space: see `Avatar.canonical_mesh`."""
        return self.avatar.canonical_mesh(**options)

    def animate(self, motion: MotionLike | BodyParams, **options: Any) -> Animation:
        """The posed surface over a motion: see `xavatar_jax.avatar.animate`."""
        return animate(self, motion, **options)

    def export_glb(
        self, path: str | os.PathLike[str], motion: Motions | None = None, **options: Any
    ) -> GlbExport:
        """Write a rigged `.glb`: see `xavatar_jax.avatar.export_glb`."""
        return export_glb(self, path, motion, **options)

    def export_weights(self, path: str | os.PathLike[str]) -> None:
        """Write the skinning of the rest surface to an `.npz`: see `export.write_weights`."""
        export_weights(self, path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the avatar to one file, without the body's arrays: see `load_avatar`."""
        save_avatar(self.avatar, path, self.body, "body_only")


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
    """`(J, kept)`, one where the weight of a joint goes."""
    carried = np.zeros((tree.num_joints, len(kept)))
    for joint in range(tree.num_joints):
        above = joint
        while above not in kept:
            above = tree.parents[above]
        carried[joint, kept.index(above)] = 1
    return carried
