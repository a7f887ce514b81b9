"""Geometry fields: a canonical point to a level, positive inside."""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..body import BodyParams, pose_groups
from ..kinematics import KinematicTree
from .networks import ImplicitMLP, MLPShape

_BATCH = 4096  # points that a network evaluates at once


class GeometryValue(NamedTuple):
    """A geometry field at one point.

    - `level`: 0 at the surface, positive and larger inside. Its unit is the link's business.
    - `feature`: what the field passes to a colour field, if anything.
    """

    level: Float[Array, ""]
    feature: Float[Array, " f"] | None = None


class AbstractGeometryField(eqx.Module):
    """A shape in canonical space, conditioned on a frame's pose and expression.

    Derive from `AbstractPlainGeometry` unless the field has use for the methods it implements.
    """

    @abc.abstractmethod
    def condition(self, params: BodyParams) -> Any:
        """Arrays that the field needs of one frame's parameters, computed once a frame."""

    @abc.abstractmethod
    def __call__(self, x_c: Float[Array, "3"], condition: Any) -> GeometryValue:
        """The field at `x_c` (metres, canonical space) under one frame's condition."""

    @abc.abstractmethod
    def carry(self, x_c: Float[Array, "3"], condition: Any) -> Float[Array, "3"]:
        """Where a condition moves a point of the neutral person, as far as the field knows.

        A search for the conditioned surface starts there.
        """

    @abc.abstractmethod
    def carried_from(
        self, x_c: Float[Array, "3"], condition: Any
    ) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """The neutral point that `carry` takes to `x_c`, and how far from `x_c` it ends, metres."""

    @abc.abstractmethod
    def carried_value(self, x: Float[Array, "3"], condition: Any) -> GeometryValue:
        """The field at `carry(x, condition)`, without the search for what is carried there."""

    @abc.abstractmethod
    def at(self, points: Float[Array, "N 3"]) -> AbstractPointCache:
        """The field at given points of the neutral person, for many conditions."""

    @abc.abstractmethod
    def within(self, params: BodyParams) -> AbstractGeometryField:
        """The field limited to the range of these (batched) parameters, those to learn from."""

    @abc.abstractmethod
    def without_zeros(self, condition: Any) -> Any:
        """A cheaper condition with the same levels. Its shapes depend on values: not under jit."""

    @property
    @abc.abstractmethod
    def batch_points(self) -> int:
        """How many points to evaluate at once, so that memory stays within bounds."""


class AbstractPointCache(eqx.Module):
    """A geometry field at N points of the neutral person, for one condition after another.

    The points move with the condition (`AbstractGeometryField.carry`).
    """

    @abc.abstractmethod
    def __call__(self, condition: Any) -> Float[Array, " N"]:
        """Levels under one condition: those of the field at `carried(condition)`."""

    @abc.abstractmethod
    def carried(self, condition: Any) -> Float[Array, "N 3"]:
        """The points under one condition, metres."""


class AbstractPlainGeometry(AbstractGeometryField):
    """A field that moves no points, has no range and no shortcuts.

    Subclasses define `condition` and `__call__` only.
    """

    def carry(self, x_c: Float[Array, "3"], condition: Any) -> Float[Array, "3"]:
        return x_c

    def carried_from(
        self, x_c: Float[Array, "3"], condition: Any
    ) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        return x_c, jnp.zeros((), x_c.dtype)

    def carried_value(self, x: Float[Array, "3"], condition: Any) -> GeometryValue:
        return self(x, condition)

    def at(self, points: Float[Array, "N 3"]) -> AbstractPointCache:
        return RecomputedPoints(self, points)

    def within(self, params: BodyParams) -> AbstractGeometryField:
        return self

    def without_zeros(self, condition: Any) -> Any:
        return condition

    @property
    def batch_points(self) -> int:
        return _BATCH


class RecomputedPoints(AbstractPointCache):
    """Any field, evaluated again for each condition, a few thousand points at a time."""

    field: AbstractGeometryField
    points: Float[Array, "N 3"]

    def __call__(self, condition: Any) -> Float[Array, " N"]:
        count = len(self.points)
        padded = jnp.pad(self.points, ((0, -count % _BATCH), (0, 0)))
        each = jax.vmap(lambda x: self.field.carried_value(x, condition).level)
        return jax.lax.map(each, padded.reshape(-1, _BATCH, 3)).reshape(-1)[:count]

    def carried(self, condition: Any) -> Float[Array, "N 3"]:
        return jax.vmap(lambda x: self.field.carry(x, condition))(self.points)


class MLPGeometry(AbstractPlainGeometry):
    """The paper's occupancy network, with its global condition (X-Avatar, section 3.1).

    The condition is body pose over pi and expression; a hand without a body takes its own pose.
    Coefficients of expression that are missing are zero; more than `num_expression` are left out.
    """

    mlp: ImplicitMLP
    joints: tuple[int, ...] = eqx.field(static=True)
    num_expression: int = eqx.field(static=True)

    def __init__(
        self,
        tree: KinematicTree,
        num_expression: int,
        shape: MLPShape,
        *,
        key: PRNGKeyArray,
    ):
        groups = pose_groups(tree)
        hands = groups["left_hand_pose"] + groups["right_hand_pose"]
        self.joints = groups["body_pose"] or hands
        self.num_expression = num_expression
        width = 3 * len(self.joints) + num_expression
        self.mlp = ImplicitMLP(shape, condition=width, init="ball", key=key)

    def condition(self, params: BodyParams) -> Float[Array, " c"]:
        pose = params.pose[np.asarray(self.joints, int)].reshape(-1) / np.pi
        expression = first_coefficients(params.expression, self.num_expression)
        return jnp.concatenate([pose.astype(expression.dtype), expression])

    def __call__(self, x_c: Float[Array, "3"], condition: Float[Array, " c"]) -> GeometryValue:
        return GeometryValue(self.mlp(x_c, condition)[0])


def first_coefficients(expression: Float[Array, " n"], count: int) -> Float[Array, " count"]:
    """So many coefficients: a motion may have fewer than the person's capture had, or more."""
    given = expression[:count]
    return jnp.pad(given, (0, count - len(given)))
