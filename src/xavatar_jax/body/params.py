"""Parameters of a posed body: one axis-angle array, with SMPL-X's names as views."""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..kinematics import TO_Y_UP, KinematicTree
from .joints import pose_groups

MAX_DEFAULT_COEFFICIENTS = 10
Side = Literal["left", "right"]


class BodyParams(eqx.Module):
    """Pose, shape, expression and translation of a body, for one frame or a batch of frames.

    - `pose`: axis-angle of every joint relative to its parent, radians, `(..., J, 3)`. Hands are
      absolute: zero is the flat hand of the template, not the mean hand.
    - `betas`, `expression`: coefficients, `(..., S)` and `(..., E)`.
    - `transl`: metres, `(..., 3)`.
    """

    pose: Float[Array, "*batch J 3"]
    betas: Float[Array, "*batch S"]
    expression: Float[Array, "*batch E"]
    transl: Float[Array, "*batch 3"]
    tree: KinematicTree = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        body: Any,
        *,
        global_orient: Any = None,
        body_pose: Any = None,
        left_hand_pose: Any = None,
        right_hand_pose: Any = None,
        jaw_pose: Any = None,
        leye_pose: Any = None,
        reye_pose: Any = None,
        pose: Any = None,
        betas: Any = None,
        expression: Any = None,
        transl: Any = None,
    ) -> BodyParams:
        """Create parameters by SMPL-X's names; the default of each is zero.

        Poses are flat, `(..., 3 n)`, or by joint, `(..., n, 3)`; leading batch axes broadcast.
        `pose` sets all joints at once and excludes the other poses.

        **Raises:** `ValueError` naming the argument, its shape and the one expected, or the joints
        that the body lacks.
        """
        tree: KinematicTree = body.tree
        given = {
            "global_orient": global_orient,
            "body_pose": body_pose,
            "left_hand_pose": left_hand_pose,
            "right_hand_pose": right_hand_pose,
            "jaw_pose": jaw_pose,
            "leye_pose": leye_pose,
            "reye_pose": reye_pose,
        }
        given = {name: value for name, value in given.items() if value is not None}
        groups = pose_groups(tree)
        parts: dict[tuple[int, ...], Array] = {}
        if pose is not None:
            if given:
                raise ValueError(f"pose already sets every joint: leave out {', '.join(given)}")
            parts[tuple(range(tree.num_joints))] = _joints("pose", pose, tree.num_joints)
        for name, value in given.items():
            if not groups[name]:
                raise ValueError(f"{name} was given, but the body's tree has no such joints")
            parts[groups[name]] = _joints(name, value, len(groups[name]))
        coefficients = {"transl": _vector("transl", transl, 3)}
        for name, value, limit in (
            ("betas", betas, body.num_betas),
            ("expression", expression, body.num_expression),
        ):
            found = _vector(name, value, min(MAX_DEFAULT_COEFFICIENTS, limit))
            if found.shape[-1] > limit:
                raise ValueError(
                    f"{name} has {found.shape[-1]} coefficients, but the body "
                    f"({body.source.describe()}) has {limit}: truncate it or load another model"
                )
            coefficients[name] = found
        if coefficients["transl"].shape[-1] != 3:
            raise ValueError(f"transl has shape {coefficients['transl'].shape}, expected (..., 3)")
        batch = jnp.broadcast_shapes(
            *(part.shape[:-2] for part in parts.values()),
            *(value.shape[:-1] for value in coefficients.values()),
        )
        full = jnp.zeros((*batch, tree.num_joints, 3), coefficients["transl"].dtype)
        for joints, part in parts.items():
            full = full.at[..., np.asarray(joints), :].set(part)
        spread = {
            name: jnp.broadcast_to(value, (*batch, value.shape[-1]))
            for name, value in coefficients.items()
        }
        return cls(pose=full, tree=tree, **spread)

    @classmethod
    def zeros(cls, body: Any, batch: tuple[int, ...] = ()) -> BodyParams:
        """The rest pose of the mean shape."""
        return cls.create(body, pose=jnp.zeros((*batch, body.num_joints, 3)))

    def __getitem__(self, index: Any) -> BodyParams:
        """Index or slice the leading batch axis."""
        if self.pose.ndim == 2:
            raise IndexError("parameters of a single frame have no batch axis to index")
        return jax.tree.map(lambda leaf: leaf[index], self)

    def __len__(self) -> int:
        if self.pose.ndim == 2:
            raise TypeError("parameters of a single frame have no length")
        return self.pose.shape[0]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes; empty for one frame."""
        return self.pose.shape[:-2]

    def _view(self, name: str) -> Float[Array, "*batch n 3"]:
        return self.pose[..., np.asarray(pose_groups(self.tree)[name], dtype=int), :]

    @property
    def global_orient(self) -> Float[Array, "*batch 3"]:
        """Orientation of the root in the world."""
        return self.pose[..., 0, :]

    @property
    def body_pose(self) -> Float[Array, "*batch n 3"]:
        """Rotations of the joints of no other group, `(..., 21, 3)` in SMPL-X."""
        return self._view("body_pose")

    @property
    def left_hand_pose(self) -> Float[Array, "*batch n 3"]:
        """Rotations of the left hand's joints, `(..., 15, 3)`."""
        return self._view("left_hand_pose")

    @property
    def right_hand_pose(self) -> Float[Array, "*batch n 3"]:
        """Rotations of the right hand's joints, `(..., 15, 3)`."""
        return self._view("right_hand_pose")

    @property
    def jaw_pose(self) -> Float[Array, "*batch n 3"]:
        """Rotation of the jaw, `(..., 1, 3)`."""
        return self._view("jaw_pose")

    @property
    def leye_pose(self) -> Float[Array, "*batch n 3"]:
        """Rotation of the left eye, `(..., 1, 3)`."""
        return self._view("leye_pose")

    @property
    def reye_pose(self) -> Float[Array, "*batch n 3"]:
        """Rotation of the right eye, `(..., 1, 3)`."""
        return self._view("reye_pose")


def check_params(body: Any, params: BodyParams, *, what: str = "params") -> None:
    """Check concrete parameters from outside the library against a body.

    **Raises:** `ValueError` naming the field and, for a batch, the first invalid frame.
    """
    if params.tree.parents != body.tree.parents:
        raise ValueError(
            f"{what} are for a tree of {params.tree.num_joints} joints; the body "
            f"({body.source.describe()}) has {body.tree.num_joints}. Use parameters made for it."
        )
    limits = {"betas": body.num_betas, "expression": body.num_expression}
    for name in ("pose", "betas", "expression", "transl"):
        value = np.asarray(getattr(params, name))
        if name in limits and value.shape[-1] > limits[name]:
            raise ValueError(
                f"{what}.{name} has shape {value.shape}, but the body has {limits[name]} columns"
            )
        bad = ~np.isfinite(value)
        if bad.any():
            where = np.argwhere(bad)[0]
            frame = f", frame {where[0]}" if params.pose.ndim > 2 else ""
            raise ValueError(
                f"{what}.{name}{frame} is not finite (entry {tuple(int(i) for i in where)}): "
                "remove or correct that frame"
            )


def with_betas(params: BodyParams, betas: ArrayLike) -> BodyParams:
    """The same parameters with the shape `(S,)` in every frame."""
    shape = jnp.asarray(betas, params.pose.dtype)
    shapes = jnp.broadcast_to(shape, (*params.pose.shape[:-2], len(shape)))
    return eqx.tree_at(lambda p: p.betas, params, shapes)


def root_rotation(params: BodyParams) -> Float[np.ndarray, "3 3"]:
    """Orientation of the root in the world, for one frame."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.array(params.pose[0], np.float64)).as_matrix()


def facing(params: BodyParams, up: str = "y") -> Float[np.ndarray, "3"]:
    """Horizontal direction that the person of one frame faces: the root's rotation of +Z."""
    to_y_up = TO_Y_UP[up]
    ahead, vertical = root_rotation(params)[:, 2], to_y_up[1]
    ahead = ahead - (ahead @ vertical) * vertical
    length = float(np.linalg.norm(ahead))
    if length < 1e-3:
        return to_y_up.T @ np.array([0.0, 0.0, 1.0])
    return ahead / length


def hands_to_absolute(body: Any, hand_pose: Any, side: Side) -> Float[Array, "*batch n 3"]:
    """Convert a hand pose relative to the mean hand (`flat_hand_mean=False`) to an absolute one.

    `hand_pose` is `(..., 45)`, `(..., 15, 3)` or PCA coefficients `(..., 6 | 12 | 24)`, which are
    expanded with the model's components.

    **Raises:** `ValueError` if the body has no such hand, or no components for PCA coefficients.
    """
    joints = _hand_joints(body, side)
    pose = jnp.asarray(hand_pose, body.template.dtype)
    if pose.shape[-2:] != (len(joints), 3):
        count = pose.shape[-1]
        if count != 3 * len(joints):
            components = body.hand_components.get(side)
            if components is None or count > len(components):
                have = "none" if components is None else str(len(components))
                raise ValueError(
                    f"{side}_hand_pose has {count} numbers, which is neither a full pose nor PCA "
                    f"coefficients of this body ({have} components)"
                )
            pose = pose @ jnp.asarray(components[:count], pose.dtype)
        pose = pose.reshape(*pose.shape[:-1], len(joints), 3)
    return pose + body.hand_mean[joints]


def hands_to_relative(
    body: Any, hand_pose: Float[Array, "*batch n 3"], side: Side
) -> Float[Array, "*batch n 3"]:
    """Convert an absolute hand pose to one relative to the mean hand, as many files store it."""
    return hand_pose - body.hand_mean[_hand_joints(body, side)]


def _hand_joints(body: Any, side: Side) -> np.ndarray:
    joints = pose_groups(body.tree)[f"{side}_hand_pose"]
    if not joints:
        raise ValueError(f"the body ({body.source.describe()}) has no {side} hand joints")
    return np.asarray(joints)


def _joints(name: str, value: Any, count: int) -> Array:
    array = jnp.asarray(value, dtype=float)
    if array.shape[-2:] == (count, 3):
        return array
    if array.ndim and array.shape[-1] == 3 * count:
        return array.reshape(*array.shape[:-1], count, 3)
    raise ValueError(
        f"{name} has shape {array.shape}, expected (..., {3 * count}) or (..., {count}, 3)"
    )


def _vector(name: str, value: Any, default: int) -> Array:
    array = jnp.zeros(default) if value is None else jnp.asarray(value, dtype=float)
    if array.ndim == 0:
        raise ValueError(f"{name} is a single number, expected a vector (..., n)")
    return array
