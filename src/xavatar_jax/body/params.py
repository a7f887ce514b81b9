"""Parameters of a posed body: one axis-angle array, with SMPL-X's names as views."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..kinematics import KinematicTree
from .joints import pose_groups

MAX_DEFAULT_COEFFICIENTS = 10


class BodyParams(eqx.Module):
    """Pose, shape, expression and place of a body, for one frame or a batch of them.

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
        """Parameters by SMPL-X's names; what is not given is zero.

        Each pose may be given flat, `(..., 3 n)`, or by joint, `(..., n, 3)`; leading batch axes
        broadcast against one another. `pose` sets all joints at once and excludes the others.

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
        groups = pose_groups(tree)
        parts: dict[tuple[int, ...], Array] = {}
        if pose is not None:
            named = [name for name, value in given.items() if value is not None]
            if named:
                raise ValueError(f"pose sets every joint already: leave out {', '.join(named)}")
            parts[tuple(range(tree.num_joints))] = _joints("pose", pose, tree.num_joints)
        else:
            for name, value in given.items():
                if value is None:
                    continue
                if not groups[name]:
                    raise ValueError(f"{name} was given, but the body's tree has no such joints")
                parts[groups[name]] = _joints(name, value, len(groups[name]))
        coefficients = {
            "betas": _vector("betas", betas, min(MAX_DEFAULT_COEFFICIENTS, body.num_betas)),
            "expression": _vector(
                "expression", expression, min(MAX_DEFAULT_COEFFICIENTS, body.num_expression)
            ),
            "transl": _vector("transl", transl, 3),
        }
        for name, limit in (("betas", body.num_betas), ("expression", body.num_expression)):
            if coefficients[name].shape[-1] > limit:
                raise ValueError(
                    f"{name} has {coefficients[name].shape[-1]} coefficients, but the body "
                    f"({body.source.describe()}) has {limit}: truncate it or load another model"
                )
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
            raise IndexError("these parameters are of a single frame: there is no batch to index")
        return jax.tree.map(lambda leaf: leaf[index], self)

    def __len__(self) -> int:
        if self.pose.ndim == 2:
            raise TypeError("these parameters are of a single frame and have no length")
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
        """Rotations of all joints that belong to no other name, `(..., 21, 3)` in SMPL-X."""
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
    """Check concrete parameters against a body, for code that reads them from outside.

    **Raises:** `ValueError` naming the field and, for a batch, the first frame that is wrong.
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
                "remove or mend that frame"
            )


def with_betas(params: BodyParams, betas: ArrayLike) -> BodyParams:
    """The same parameters with one shape `(S,)` for all of them in place of theirs."""
    shape = jnp.asarray(betas, params.pose.dtype)
    shapes = jnp.broadcast_to(shape, (*params.pose.shape[:-2], len(shape)))
    return eqx.tree_at(lambda p: p.betas, params, shapes)


def _joints(name: str, value: Any, count: int) -> Array:
    array = jnp.asarray(value, dtype=float)
    if (
        array.ndim >= 1
        and array.shape[-1] == 3 * count
        and not (array.ndim >= 2 and array.shape[-2:] == (count, 3))
    ):
        array = array.reshape(*array.shape[:-1], count, 3)
    if array.ndim < 2 or array.shape[-2:] != (count, 3):
        raise ValueError(
            f"{name} has shape {array.shape}, expected (..., {3 * count}) or (..., {count}, 3)"
        )
    return array


def _vector(name: str, value: Any, default: int) -> Array:
    array = jnp.zeros(default) if value is None else jnp.asarray(value, dtype=float)
    if array.ndim == 0:
        raise ValueError(f"{name} is a single number, expected a vector (..., n)")
    return array
