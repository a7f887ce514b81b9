"""Geometry fields: a canonical point to an occupancy logit, positive inside."""

from __future__ import annotations

import abc
from functools import partial
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..body import BodyParams, pose_groups
from ..kinematics import KinematicTree, axis_angle_to_matrix
from .encodings import HashEncoding
from .expression import ExpressionGrid
from .fixed import AbstractFixedPoints, FixedHash, FixedPoints
from .mlp import ImplicitMLP, MLPShape
from .softplus import softplus

# Of the search for the place that an expression has moved to a point.
_SUBSTITUTIONS = 3


class AbstractGeometryField(eqx.Module):
    """An occupancy logit in canonical space, conditioned on a frame's pose and expression."""

    @abc.abstractmethod
    def condition(self, params: BodyParams) -> Any:
        """What the field keeps of one frame's parameters: arrays, computed once a frame."""

    @abc.abstractmethod
    def __call__(self, x_c: Float[Array, "3"], condition: Any) -> Float[Array, ""]:
        """Logit at `x_c` (metres, canonical space) under one frame's condition."""

    def carry(self, x_c: Float[Array, "3"], condition: Any) -> Float[Array, "3"]:
        """Where a place of the neutral person goes under a condition, if the field knows.

        Its surface is sought from there. A field that knows nothing of it leaves it where it is.
        """
        return x_c

    def at(self, points: Float[Array, "N 3"]) -> AbstractFixedPoints:
        """The field at points, for many conditions that carry them: what can be kept is kept."""
        return FixedPoints(self, points)

    def within(self, params: BodyParams) -> Self:
        """The field when it is to learn from frames with these parameters, batched.

        A field may keep what range they have, and read nothing beyond it.
        """
        return self

    def without_zeros(self, condition: Any) -> Any:
        """A condition without what is zero in it: the same logits, sooner.

        For many points under one known condition; it cannot be traced.
        """
        return condition


class MLPGeometry(AbstractGeometryField):
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
        expression = _first(params.expression, self.num_expression)
        return jnp.concatenate([pose.astype(expression.dtype), expression])

    def __call__(self, x_c: Float[Array, "3"], condition: Float[Array, " c"]) -> Float[Array, ""]:
        out = self.mlp(x_c, condition)
        return out[0]


class LocalCondition(NamedTuple):
    """What a `HashGeometry` reads of one frame.

    - `joints`: features of each joint's rotation, which act around `centres` (metres) and fade with
      the squared distance by `fade`.
    - `expression`: coefficients for what is learned, in the range of `within`; `moves`: those for
      how places move, as they are. None of them: all are zero.
    """

    joints: Float[Array, "J K"]
    centres: Float[Array, "J 3"]
    fade: Float[Array, " J"]
    expression: Float[Array, " E"]
    moves: Float[Array, " E"]


class HashGeometry(AbstractGeometryField):
    """Feature grids and a small MLP, with a condition that is local.

    A joint's rotation changes shape near that joint only: its features, linear in the entries of
    the rotation less the identity (as pose blend shapes are), fade with the distance from the
    joint over half the length of the bones that meet there. Expression acts on the face alone, by
    an `ExpressionGrid` in its box. Levels finer than the trunk needs are read inside the boxes
    of `detail` alone.

    Where the body model's own expression moves places of the face (`moves`), the field is that of
    the place which is moved to the point: a smile carries the corners of a mouth over centimetres,
    further than the features of one place could follow. What is left is learned.

    For what is learned, entries of rotations and coefficients of expression are clipped to the
    range that `within` found in the frames: what noise teaches about a joint that hardly moved
    would be multiplied by the angle that it turns by later. How the body model's own expression
    moves places is not learned, and not clipped.
    """

    encoding: HashEncoding
    hidden: tuple[Float[Array, "out in"], ...]
    biases: tuple[Float[Array, " out"], ...]
    pose_weights: Float[Array, "J 9 K"]
    expressive: ExpressionGrid | None
    moves: ExpressionGrid | None
    joints: Float[Array, "J 3"]
    pose_range: Float[Array, "2 J 9"]
    expression_range: Float[Array, "2 E"]
    reach: tuple[float, ...] = eqx.field(static=True)
    detail_low: tuple[tuple[float, float, float], ...] = eqx.field(static=True)
    detail_high: tuple[tuple[float, float, float], ...] = eqx.field(static=True)
    detail_spacing: tuple[float, ...] = eqx.field(static=True)
    trunk_spacing: float = eqx.field(static=True)
    sharpness: float = eqx.field(static=True)
    tree: KinematicTree = eqx.field(static=True)

    def __init__(
        self,
        tree: KinematicTree,
        joints: Float[np.ndarray, "J 3"],
        expressive: ExpressionGrid | None,
        low: Float[np.ndarray, "3"],
        high: Float[np.ndarray, "3"],
        *,
        spacing: tuple[float, ...],
        trunk_spacing: float,
        detail: tuple[tuple[np.ndarray, np.ndarray, float], ...],
        features: int,
        log2_size: int,
        width: int,
        condition_width: int,
        sharpness: float,
        key: PRNGKeyArray,
    ):
        keys = jax.random.split(key, 4)
        self.encoding = HashEncoding(
            low, high, spacing=spacing, features=features, log2_size=log2_size, key=keys[0]
        )
        expression_width = 0 if expressive is None else expressive.table.shape[-1]
        fan_in = (self.encoding.width + condition_width + expression_width, width, width)
        fan_out = (width, width, 1)
        self.hidden = _normal_layers(keys[1:], fan_in, fan_out)
        self.biases = tuple(jnp.zeros(m) for m in fan_out)
        # Zero at first: the start is the same surface in every pose.
        self.pose_weights = jnp.zeros((tree.num_joints, 9, condition_width))
        self.expressive = expressive
        self.moves = None
        self.joints = jnp.asarray(joints, jnp.float32)
        known = 0 if expressive is None else expressive.table.shape[1]
        self.pose_range = _everything(tree.num_joints, 9)
        self.expression_range = _everything(known)
        self.reach = _joint_reach(tree, joints)
        self.detail_low = _triples([box[0] for box in detail])
        self.detail_high = _triples([box[1] for box in detail])
        self.detail_spacing = tuple(float(box[2]) for box in detail)
        self.trunk_spacing = trunk_spacing
        self.sharpness = sharpness
        self.tree = tree

    def condition(self, params: BodyParams) -> LocalCondition:
        """A row for each joint, so that a point's condition is its nearness times these rows."""
        pose = _clipped(_turned(params.pose), self.pose_range)
        rows = jnp.einsum("jf,jfk->jk", pose, self.pose_weights)
        given = self._known(params.expression)
        clipped = _clipped(given, self.expression_range)
        return LocalCondition(rows, *self._around_joints(rows.dtype), clipped, given)

    def within(self, params: BodyParams) -> Self:
        shown = (
            _range(jax.vmap(_turned)(jnp.asarray(params.pose))),
            _range(jax.vmap(self._known)(jnp.asarray(params.expression))),
        )
        return eqx.tree_at(lambda g: (g.pose_range, g.expression_range), self, shown)

    def _known(self, expression: Float[Array, " n"]) -> Float[Array, " E"]:
        return _first(expression, self.expression_range.shape[1])

    @property
    def fixed_leaves(self) -> tuple[Array, ...]:
        """Leaves that are the person's and the frames', and never learned."""
        return self.joints, self.pose_range, self.expression_range

    def carry(self, x_c: Float[Array, "3"], condition: LocalCondition) -> Float[Array, "3"]:
        return x_c + self._moved(x_c, condition)

    def carried_from(self, x_c: Float[Array, "3"], condition: LocalCondition) -> Float[Array, "3"]:
        """The place that `carry` takes to `x_c`, by a few rounds of substitution."""
        x = x_c
        for _ in range(_SUBSTITUTIONS):
            x = x_c - self._moved(x, condition)
        return x

    def _moved(self, x: Float[Array, "3"], condition: LocalCondition) -> Float[Array, "3"]:
        """How far the expression moves a place, metres."""
        if self.moves is None or not len(condition.moves):
            return jnp.zeros_like(x)
        moves = jax.lax.stop_gradient(self.moves)
        return moves.read(moves.under(condition.moves.astype(moves.table.dtype)), x)

    def at(self, points: Float[Array, "N 3"]) -> FixedHash:
        features = jax.vmap(self._features)(points)
        width = self.encoding.width
        weight, bias = self.hidden[0], self.biases[0]
        first = jnp.matmul(features, weight[:, :width].T, precision=jax.lax.Precision.HIGHEST)
        return FixedHash(
            first=first + bias,
            nearness=jax.vmap(lambda x: _nearness(x, *self._around_joints(x.dtype)))(points),
            expressive=None if self.expressive is None else jax.vmap(self.expressive)(points),
            points=points,
            moves=None if self.moves is None else jax.vmap(self.moves)(points),
            from_condition=weight[:, width:],
            hidden=self.hidden[1:],
            biases=self.biases[1:],
            sharpness=self.sharpness,
        )

    def without_zeros(self, condition: LocalCondition) -> LocalCondition:
        # Rows are zero for joints at rest, and coefficients for a neutral face.
        used = np.flatnonzero(np.asarray(condition.joints).any(axis=1))
        return LocalCondition(
            condition.joints[used],
            condition.centres[used],
            condition.fade[used],
            _if_any(condition.expression),
            _if_any(condition.moves),
        )

    def __call__(self, x_c: Float[Array, "3"], condition: LocalCondition) -> Float[Array, ""]:
        joints, centres, fade, expression, _ = condition
        x_c = self.carried_from(x_c, condition)
        h = [self._features(x_c), _nearness(x_c, centres, fade) @ joints]
        if self.expressive is not None and len(expression):
            nodes = self.expressive.under(expression)
            h.append(self.expressive.read(nodes, x_c))
        h = jnp.concatenate(h)
        last = len(self.hidden) - 1
        for k, (weight, bias) in enumerate(zip(self.hidden, self.biases, strict=True)):
            h = weight[:, : len(h)] @ h + bias  # narrower, where expression is left out
            if k < last:
                h = softplus(h, self.sharpness)
        return h[0]

    def _features(self, x: Float[Array, "3"]) -> Float[Array, " width"]:
        return (self.encoding(x) * self._level_mask(x)[:, None]).reshape(-1)

    def _around_joints(self, dtype: Any) -> tuple[Float[Array, "J 3"], Float[Array, " J"]]:
        """Around where each joint's condition acts, and how it fades: see `_nearness`."""
        fade = jnp.asarray(-0.5 / np.asarray(self.reach) ** 2, dtype)
        return jax.lax.stop_gradient(self.joints).astype(dtype), fade

    def _level_mask(self, x: Float[Array, "3"]) -> Float[Array, " levels"]:
        """1 for levels read at `x`, falling to 0 over the last two centimetres of a box."""
        spacing = np.asarray(self.encoding.spacing)
        mask = jnp.asarray(spacing >= self.trunk_spacing * 0.999, x.dtype)
        for low, high, finest in zip(
            self.detail_low, self.detail_high, self.detail_spacing, strict=True
        ):  # a handful of boxes
            depth = jnp.minimum(x - jnp.asarray(low), jnp.asarray(high) - x).min()
            inside = jnp.clip(depth / 0.02, 0, 1)
            mask = jnp.maximum(mask, inside * jnp.asarray(spacing >= finest * 0.999, x.dtype))
        return mask


def _first(expression: Float[Array, " n"], count: int) -> Float[Array, " count"]:
    """So many coefficients: a motion may have fewer than the person's capture had, or more."""
    given = expression[:count]
    return jnp.pad(given, (0, count - len(given)))


def _if_any(coefficients: Float[Array, " E"]) -> Float[Array, " _"]:
    return coefficients if np.asarray(coefficients).any() else coefficients[:0]


def _turned(pose: Float[Array, "J 3"]) -> Float[Array, "J 9"]:
    """Rotations less the identity; none of the root's."""
    rotations = axis_angle_to_matrix(pose)
    return (rotations - jnp.eye(3, dtype=rotations.dtype)).reshape(-1, 9).at[0].set(0)


def _everything(*shape: int) -> Float[Array, "2 *shape"]:
    return jnp.stack([jnp.full(shape, -jnp.inf), jnp.full(shape, jnp.inf)])


def _range(values: Float[Array, "F *shape"]) -> Float[Array, "2 *shape"]:
    """Least and most of each entry; zero, which fields know from the start, is among them."""
    found = jnp.stack([jnp.minimum(values.min(0), 0), jnp.maximum(values.max(0), 0)])
    return found.astype(jnp.float32)


def _clipped(
    values: Float[Array, "*shape"], bounds: Float[Array, "2 *shape"]
) -> Float[Array, "*shape"]:
    low, high = jax.lax.stop_gradient(bounds).astype(values.dtype)
    return jnp.clip(values, low, high)


def _nearness(
    x: Float[Array, "3"], centres: Float[Array, "J 3"], fade: Float[Array, " J"]
) -> Float[Array, " J"]:
    """How much of each joint's condition acts at `x`: a Gaussian of the distance."""
    # By axis: compiled for a CPU, a sum over three is a loop for each joint.
    u, v, w = x[:, None] - centres.astype(x.dtype).T
    return jnp.exp((u * u + v * v + w * w) * fade.astype(x.dtype))


@partial(jax.jit, static_argnums=(1, 2))
def _normal_layers(
    keys: PRNGKeyArray, fan_in: tuple[int, ...], fan_out: tuple[int, ...]
) -> tuple[Float[Array, "out in"], ...]:
    return tuple(
        jax.random.normal(k, (m, n)) * np.sqrt(2 / n)
        for k, n, m in zip(keys, fan_in, fan_out, strict=True)
    )


def _joint_reach(
    tree: KinematicTree, joints: Float[np.ndarray, "J 3"], least: float = 0.012, most: float = 0.15
) -> tuple[float, ...]:
    """Half the mean length of the bones that meet at each joint, metres, within bounds."""
    lengths: list[list[float]] = [[] for _ in range(tree.num_joints)]
    for joint, parent in enumerate(tree.parents):
        if parent >= 0:
            length = float(np.linalg.norm(joints[joint] - joints[parent]))
            lengths[joint].append(length)
            lengths[parent].append(length)
    means = [np.mean(group) if group else most for group in lengths]
    return tuple(float(np.clip(0.5 * mean, least, most)) for mean in means)


def _triples(rows: Any) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(x), float(y), float(z)) for x, y, z in rows)
