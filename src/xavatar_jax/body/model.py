"""The body model: blend shapes, joint regression and skinning, as pure functions of one frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..kinematics import (
    KinematicTree,
    axis_angle_to_matrix,
    inverse_rigid,
    relative_transforms,
    skin_points,
)
from .params import BodyParams

# Posing is geometry: products with ten-bit mantissas would move vertices by millimetres.
_PRECISION = jax.lax.Precision.HIGHEST


@dataclass(frozen=True)
class BodySource:
    """Where a body came from: what an avatar file keeps in place of licensed arrays."""

    path: str
    kind: str
    gender: str
    checksum: str

    def describe(self) -> str:
        """Kind, gender and path, for messages."""
        return f"{self.kind}, {self.gender}, {self.path}"


class BodyModel(eqx.Module):
    """A template mesh with blend shapes on a kinematic tree. Metres; the template's own axes.

    The joint regressor is applied to the template and to the shape directions once, so that
    joints cost J rows instead of V.
    """

    template: Float[Array, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    shape_dirs: Float[Array, "V 3 S"]
    expression_dirs: Float[Array, "V 3 E"]
    pose_dirs: Float[Array, "V 3 P"]
    joint_regressor: Float[Array, "J V"]
    joint_template: Float[Array, "J 3"]
    joint_shape_dirs: Float[Array, "J 3 S"]
    joint_expression_dirs: Float[Array, "J 3 E"]
    weights: Float[Array, "V J"]
    part_labels: Int[np.ndarray, " V"]
    colors: Int[np.ndarray, "V 3"] | None
    hand_mean: Float[Array, "J 3"]
    hand_components: dict[str, Float[np.ndarray, "n m"]]
    tree: KinematicTree = eqx.field(static=True)
    source: BodySource = eqx.field(static=True)

    @property
    def kind(self) -> str:
        """One of "smplx", "smplh", "smpl", "mano" and "other"."""
        return self.source.kind

    @property
    def num_vertices(self) -> int:
        """V, vertices of the template."""
        return self.template.shape[0]

    @property
    def num_joints(self) -> int:
        """J, joints of the tree."""
        return self.tree.num_joints

    @property
    def num_betas(self) -> int:
        """S, shape directions."""
        return self.shape_dirs.shape[-1]

    @property
    def num_expression(self) -> int:
        """E, expression directions."""
        return self.expression_dirs.shape[-1]


class Posed(NamedTuple):
    """Vertices `(V, 3)` and joints `(J, 3)` of a posed body, metres."""

    vertices: Float[Array, "V 3"]
    joints: Float[Array, "J 3"]


def rest_joints(
    body: BodyModel, betas: Float[Array, " S"], expression: Float[Array, " E"] | None = None
) -> Float[Array, "J 3"]:
    """Joints of the unposed body of this shape (and expression), metres."""
    joints = body.joint_template + _combine(body.joint_shape_dirs, betas)
    if expression is not None:
        joints = joints + _combine(body.joint_expression_dirs, expression)
    return joints


def rest_vertices(
    body: BodyModel, betas: Float[Array, " S"], expression: Float[Array, " E"] | None = None
) -> Float[Array, "V 3"]:
    """Vertices of the unposed body of this shape (and expression), metres."""
    vertices = body.template + _combine(body.shape_dirs, betas)
    if expression is not None:
        vertices = vertices + _combine(body.expression_dirs, expression)
    return vertices


# Compiled as wholes, here and below: step by step, a first call would compile a hundred programs.
@eqx.filter_jit
def pose_body(body: BodyModel, params: BodyParams) -> Posed:
    """Pose one frame; `jax.vmap(partial(pose_body, body))` poses many.

    Shape, expression and pose blend shapes, then linear blend skinning (SMPL-X: Pavlakos et al.,
    CVPR 2019). Differentiable in every parameter, at zero rotation too.

    **Raises:** `ValueError` when tracing if the parameters do not fit the body.
    """
    _check_single(body, params)
    rotations = axis_angle_to_matrix(params.pose)
    vertices = rest_vertices(body, params.betas, params.expression)
    vertices = vertices + pose_offsets(body, rotations)
    joints = rest_joints(body, params.betas, params.expression)
    transforms = relative_transforms(body.tree, rotations, joints)
    posed = skin_points(vertices, body.weights, transforms)
    posed_joints = jnp.einsum("jab,jb->ja", transforms[:, :3, :3], joints, precision=_PRECISION)
    return Posed(posed + params.transl, posed_joints + transforms[:, :3, 3] + params.transl)


def pose_offsets(body: BodyModel, rotations: Float[Array, "J 3 3"]) -> Float[Array, "V 3"]:
    """Pose correctives: linear in the entries of every non-root rotation less the identity."""
    feature = (rotations[1:] - jnp.eye(3, dtype=rotations.dtype)).reshape(-1)
    return jnp.einsum("vcp,p->vc", body.pose_dirs, feature, precision=_PRECISION)


def canonical_pose(body: BodyModel) -> Float[Array, "J 3"]:
    """The pose of canonical space: legs apart, mouth a little open, hands flat.

    Hips turn by 30 degrees about z and the jaw by 0.2 rad about x (X-Avatar's released code).
    A tree without these joints, or a body outside the SMPL family, whose axes may differ, keeps
    its rest pose.
    """
    pose = np.zeros((body.num_joints, 3))
    if body.kind != "other":
        for name, rotation in (
            ("left_hip", (0, 0, np.pi / 6)),
            ("right_hip", (0, 0, -np.pi / 6)),
            ("jaw", (0.2, 0, 0)),
        ):
            for joint in body.tree.indices(name):
                pose[joint] = rotation
    return jnp.asarray(pose, body.template.dtype)


def canonical_params(body: BodyModel, betas: Float[Array, " S"] | None = None) -> BodyParams:
    """Parameters of the canonical body of this shape: no expression, at the origin."""
    return BodyParams.create(body, pose=canonical_pose(body), betas=betas)


@eqx.filter_jit
def canonical_vertices(body: BodyModel, betas: Float[Array, " S"]) -> Float[Array, "V 3"]:
    """The body of this shape in the canonical pose, metres."""
    return pose_body(body, canonical_params(body, betas)).vertices


@eqx.filter_jit
def canonical_joints(body: BodyModel, betas: Float[Array, " S"]) -> Float[Array, "J 3"]:
    """Joints of the body of this shape in the canonical pose, metres."""
    joints = rest_joints(body, betas)
    transforms = relative_transforms(body.tree, axis_angle_to_matrix(canonical_pose(body)), joints)
    moved = jnp.einsum("jab,jb->ja", transforms[:, :3, :3], joints, precision=_PRECISION)
    return moved + transforms[:, :3, 3]


@eqx.filter_jit
def canonical_expression_dirs(body: BodyModel) -> Float[Array, "V 3 E"]:
    """Where each coefficient of expression moves a vertex in the canonical pose, metres.

    The directions turn with the bones; joints stay, as in `bone_transforms`.
    """
    rotations = relative_transforms(
        body.tree, axis_angle_to_matrix(canonical_pose(body)), body.joint_template
    )[:, :3, :3]
    turn = jnp.einsum("vj,jab->vab", body.weights, rotations, precision=_PRECISION)
    return jnp.einsum("vab,vbe->vae", turn, body.expression_dirs, precision=_PRECISION)


@eqx.filter_jit
def bone_transforms(body: BodyModel, params: BodyParams) -> Float[Array, "J 4 4"]:
    """Transforms of every bone from canonical space to one posed frame, translation included.

    $B_i = A_i(\\theta) A_i(\\theta_{cano})^{-1}$ with the canonical body of the same shape and no
    expression (X-Avatar, section 3). Use `jax.vmap` over a batch of parameters.

    **Raises:** `ValueError` for batched parameters, or those of another tree.
    """
    _check_single(body, params)
    posed = relative_transforms(
        body.tree,
        axis_angle_to_matrix(params.pose),
        rest_joints(body, params.betas, params.expression),
    )
    canonical = relative_transforms(
        body.tree, axis_angle_to_matrix(canonical_pose(body)), rest_joints(body, params.betas)
    )
    transforms = jnp.matmul(posed, inverse_rigid(canonical), precision=_PRECISION)
    return transforms.at[:, :3, 3].add(params.transl)


def with_template(body: BodyModel, vertices: Float[np.ndarray, "V 3"]) -> BodyModel:
    """The same body with a subject's own template (GRAB's `vtemp`), its joints regressed from it.

    Shape coefficients stay, as offsets from the new template: pass zero betas for the subject.

    **Raises:** `ValueError` if the vertex count differs.
    """
    if vertices.shape != body.template.shape:
        raise ValueError(
            f"the template has shape {vertices.shape}, expected {body.template.shape}: "
            "it must have the body's own topology"
        )
    template = jnp.asarray(vertices, body.template.dtype)
    joints = jnp.matmul(body.joint_regressor, template, precision=_PRECISION)
    # Another template is another body: an avatar learned on it must not load on the plain model.
    digest = hashlib.sha256(body.source.checksum.encode())
    digest.update(np.ascontiguousarray(vertices, np.float32).tobytes())
    source = replace(body.source, checksum=digest.hexdigest())
    return replace(body, template=template, joint_template=joints, source=source)


def _combine(
    directions: Float[Array, "n 3 S"], coefficients: Float[Array, " K"]
) -> Float[Array, "n 3"]:
    used = directions[..., : coefficients.shape[-1]]
    return jnp.einsum("vck,k->vc", used, coefficients, precision=_PRECISION)


def _check_single(body: BodyModel, params: BodyParams) -> None:
    expected = (body.num_joints, 3)
    if params.pose.shape != expected:
        hint = " Use jax.vmap for a batch." if params.pose.ndim > 2 else ""
        raise ValueError(
            f"params.pose has shape {params.pose.shape}, but the body ({body.source.describe()}) "
            f"takes {expected}.{hint}"
        )
    for name, limit in (("betas", body.num_betas), ("expression", body.num_expression)):
        shape = getattr(params, name).shape
        if len(shape) != 1 or shape[0] > limit:
            raise ValueError(f"params.{name} has shape {shape}, expected (n,) with n <= {limit}")
