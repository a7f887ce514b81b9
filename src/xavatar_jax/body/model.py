"""Blend shapes, joint regression and skinning of a body, as pure functions of one frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from ..kinematics import (
    KinematicTree,
    axis_angle_to_matrix,
    inverse_rigid,
    relative_transforms,
    skin_points,
)
from .params import BodyParams
from .parts import Parts

# Products with ten-bit mantissas move vertices by millimetres.
_PRECISION = jax.lax.Precision.HIGHEST
_CHUNK = 1 << 20  # numbers hashed at once; the directions of a body have tens of millions


@dataclass(frozen=True)
class BodySource:
    """Origin of a body. Avatar files store this instead of licensed arrays."""

    path: str
    kind: str
    gender: str
    checksum: str

    def describe(self) -> str:
        """Kind, gender and path, for messages."""
        return f"{self.kind}, {self.gender}, {self.path}"


class BodyModel(eqx.Module):
    """A template mesh with blend shapes on a kinematic tree, in metres and the template's axes.

    `joint_*` are the regressed joints of the template and its directions, precomputed.
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
    parts: Parts
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
    def part_labels(self) -> Int[np.ndarray | Array, " V"]:
        """Part label of each vertex: `parts.labels`."""
        return self.parts.labels

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


def make_body(
    *,
    template: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    joint_regressor: Float[np.ndarray, "J V"],
    weights: Float[np.ndarray, "V J"],
    parts: Parts,
    tree: KinematicTree,
    source: BodySource,
    shape_dirs: Float[np.ndarray, "V 3 S"] | None = None,
    expression_dirs: Float[np.ndarray, "V 3 E"] | None = None,
    pose_dirs: Float[np.ndarray, "V 3 P"] | None = None,
    joints: Float[np.ndarray, "J 3"] | None = None,
    hand_mean: Float[np.ndarray, "J 3"] | None = None,
    hand_components: dict[str, Float[np.ndarray, "n m"]] | None = None,
    colors: Int[np.ndarray, "V 3"] | None = None,
) -> BodyModel:
    """Build a body from NumPy arrays, in JAX's default float type. Directions default to none.

    Joints are regressed in float64, since a row of the regressor sums over thousands of vertices;
    `joints` replaces those of the template.
    """
    bones = tree.num_joints
    none = np.zeros((len(template), 3, 0))
    shape_dirs = none if shape_dirs is None else shape_dirs
    expression_dirs = none if expression_dirs is None else expression_dirs
    if pose_dirs is None:
        pose_dirs = np.zeros((len(template), 3, 9 * (bones - 1)))

    def regress(values: np.ndarray) -> np.ndarray:
        return np.tensordot(joint_regressor.astype(np.float64), values.astype(np.float64), axes=1)

    def cast(value: np.ndarray) -> Array:
        return jnp.asarray(value, float)

    return BodyModel(
        template=cast(template),
        faces=faces,
        shape_dirs=cast(shape_dirs),
        expression_dirs=cast(expression_dirs),
        pose_dirs=cast(pose_dirs),
        joint_regressor=cast(joint_regressor),
        joint_template=cast(regress(template) if joints is None else joints),
        joint_shape_dirs=cast(regress(shape_dirs)),
        joint_expression_dirs=cast(regress(expression_dirs)),
        weights=cast(weights),
        parts=parts,
        colors=colors,
        hand_mean=cast(np.zeros((bones, 3)) if hand_mean is None else hand_mean),
        hand_components=hand_components or {},
        tree=tree,
        source=source,
    )


def rest_joints(
    body: BodyModel, betas: Float[Array, " S"], expression: Float[Array, " E"] | None = None
) -> Float[Array, "J 3"]:
    """Joints of the unposed body of this shape (and expression), metres."""
    joints = body.joint_template + _combine(body.joint_shape_dirs, betas)
    if expression is None:
        return joints
    return joints + _combine(body.joint_expression_dirs, expression)


def rest_vertices(
    body: BodyModel, betas: Float[Array, " S"], expression: Float[Array, " E"] | None = None
) -> Float[Array, "V 3"]:
    """Vertices of the unposed body of this shape (and expression), metres."""
    vertices = body.template + _combine(body.shape_dirs, betas)
    if expression is None:
        return vertices
    return vertices + _combine(body.expression_dirs, expression)


# Jitted here and below: otherwise the first call compiles a hundred small programs.
@eqx.filter_jit
def pose_body(body: BodyModel, params: BodyParams) -> Posed:
    """Pose one frame; `jax.vmap(partial(pose_body, body))` poses many.

    Shape, expression and pose blend shapes, then linear blend skinning (SMPL-X: Pavlakos et al.,
    CVPR 2019). Differentiable in every parameter, including at zero rotation.

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
    """The pose of canonical space: legs apart, mouth slightly open, hands flat.

    Hips turn by 30 degrees about z and the jaw by 0.2 rad about x (X-Avatar's released code).
    Missing joints are skipped. A body outside the SMPL family, whose axes may differ, keeps its
    rest pose.
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
    """Expression blend shapes in the canonical pose, metres per coefficient.

    The directions turn with the bones; joints do not move, as in `bone_transforms`.
    """
    rotations = relative_transforms(
        body.tree, axis_angle_to_matrix(canonical_pose(body)), body.joint_template
    )[:, :3, :3]
    turn = jnp.einsum("vj,jab->vab", body.weights, rotations, precision=_PRECISION)
    return jnp.einsum("vab,vbe->vae", turn, body.expression_dirs, precision=_PRECISION)


@eqx.filter_jit
def bone_transforms(body: BodyModel, params: BodyParams) -> Float[Array, "J 4 4"]:
    """Transforms of all bones from canonical space to one posed frame, translation included.

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
    """The same body with a person's template (GRAB's `vtemp`) and joints regressed from it.

    Shape coefficients become offsets from the new template: pass zero betas for the person.

    **Raises:** `ValueError` if the vertex count differs.
    """
    if vertices.shape != body.template.shape:
        raise ValueError(
            f"the template has shape {vertices.shape}, expected {body.template.shape}: "
            "it must have the topology of the body"
        )
    template = jnp.asarray(vertices, body.template.dtype)
    joints = jnp.matmul(body.joint_regressor, template, precision=_PRECISION)
    # A different checksum: an avatar trained on this body must not load on the original one.
    digest = hashlib.sha256(body.source.checksum.encode())
    digest.update(np.ascontiguousarray(vertices, np.float32).tobytes())
    source = replace(body.source, checksum=digest.hexdigest())
    return replace(body, template=template, joint_template=joints, source=source)


def body_checksum(
    tree: KinematicTree, faces: Int[np.ndarray, "F 3"], *arrays: Shaped[np.ndarray, "..."]
) -> str:
    """SHA-256 of a tree, faces and arrays to six decimals, as hexadecimal digits.

    Independent of the file format and of how a processor rounds.
    """
    digest = hashlib.sha256(repr((tree.names, tree.parents)).encode())
    digest.update(np.ascontiguousarray(faces, np.int32).tobytes())
    for array in arrays:
        flat = np.ascontiguousarray(array).reshape(-1)
        for start in range(0, len(flat), _CHUNK):
            chunk = flat[start : start + _CHUNK].astype(np.float64)
            digest.update(np.rint(chunk * 1e6).astype(np.int64).tobytes())
    return digest.hexdigest()


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
