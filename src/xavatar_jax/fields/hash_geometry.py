"""The hash-grid geometry field: feature grids and a small network, with a local condition."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..body import BodyParams
from ..kinematics import KinematicTree, axis_angle_to_matrix
from .feature_grids import ExpressionGrid, HashEncoding
from .geometry import AbstractGeometryField, AbstractPointCache, GeometryValue, first_coefficients
from .networks import softplus
from .roles import fixed, misshapen, stored

_EXACT = jax.lax.Precision.HIGHEST

MOST_EXPRESSION = 5.0
"""Largest coefficient, in standard deviations, by which expression moves the field."""

_CARRY_STEPS = 8
_CARRY_TOLERANCE = 1e-5  # metres
_LARGEST_STEP = 0.02  # metres, of one step of the inverse of `carry`


class LocalCondition(NamedTuple):
    """What a `HashGeometry` reads of one frame.

    - `joints`: features of each joint's rotation, which act around `centres` (metres) and fade with
      the squared distance by `fade`.
    - `expression`: coefficients for what is learned, clipped to the range of `within`.
    - `moves`: coefficients for how points move, clipped to `MOST_EXPRESSION`.

    Either set of coefficients may be empty, which means zero.
    """

    joints: Float[Array, "J K"]
    centres: Float[Array, "J 3"]
    fade: Float[Array, " J"]
    expression: Float[Array, " E"]
    moves: Float[Array, " E"]


class HashGeometry(AbstractGeometryField):
    """Feature grids and a small MLP, with a condition that is local.

    A joint's rotation changes the shape near that joint only: its features, linear in the entries
    of the rotation minus the identity (like pose blend shapes), fade with the distance from the
    joint over half the length of the bones that meet there. Expression acts on the face only, by
    an `ExpressionGrid` in its box. Levels finer than `trunk_spacing` are read only inside the
    boxes of `detail`.

    `moves` holds how the body model's own expression moves points of the face. The field at a
    point is then that of the neutral point which moves there (`carried_from`), because a smile
    carries the corners of a mouth over centimetres, further than the features at one place could
    follow. The rest is learned.

    What is learned sees rotations and coefficients clipped to the range that `within` found in the
    training frames: otherwise the noise learned about a joint that hardly moved would be
    multiplied by any larger angle.
    """

    encoding: HashEncoding
    hidden: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    pose_weights: Float[Array, "J 9 K"]
    expressive: ExpressionGrid | None
    moves: ExpressionGrid | None = fixed()
    joints: Float[Array, "J 3"] = stored()
    reach: Float[Array, " J"] = stored()
    pose_range: Float[Array, "2 J 9"] = stored()
    expression_range: Float[Array, "2 E"] = stored()
    detail_low: Float[Array, "boxes 3"] = stored()
    detail_high: Float[Array, "boxes 3"] = stored()
    detail_spacing: tuple[float, ...] = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]
    trunk_spacing: float = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]
    sharpness: float = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]

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
        self.reach = jnp.asarray(_joint_reach(tree, joints), jnp.float32)
        boxes = np.array([box[:2] for box in detail]).reshape(-1, 2, 3)
        self.detail_low = jnp.asarray(boxes[:, 0], jnp.float32)
        self.detail_high = jnp.asarray(boxes[:, 1], jnp.float32)
        self.detail_spacing = tuple(float(box[2]) for box in detail)
        self.trunk_spacing = trunk_spacing
        self.sharpness = sharpness

    def condition(self, params: BodyParams) -> LocalCondition:
        """A row for each joint, so that a point's condition is its nearness times these rows."""
        pose = _clipped(_turned(params.pose), self.pose_range)
        rows = jnp.einsum("jf,jfk->jk", pose, self.pose_weights)
        given = self._known(params.expression)
        clipped = _clipped(given, self.expression_range)
        moves = jnp.clip(given, -MOST_EXPRESSION, MOST_EXPRESSION)
        return LocalCondition(rows, *self._around_joints(rows.dtype), clipped, moves)

    def within(self, params: BodyParams) -> HashGeometry:
        shown = (
            _range(jax.vmap(_turned)(jnp.asarray(params.pose))),
            _range(jax.vmap(self._known)(jnp.asarray(params.expression))),
        )
        return eqx.tree_at(lambda g: (g.pose_range, g.expression_range), self, shown)

    def _known(self, expression: Float[Array, " n"]) -> Float[Array, " E"]:
        return first_coefficients(expression, self.expression_range.shape[1])

    def carry(self, x_c: Float[Array, "3"], condition: LocalCondition) -> Float[Array, "3"]:
        return x_c + self._moved(x_c, condition)

    def carried_from(
        self, x_c: Float[Array, "3"], condition: LocalCondition
    ) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """The neutral point that `carry` takes to `x_c`, and how far from `x_c` it really ends.

        A damped Newton iteration, to 1e-5 m. An expression so strong that it folds the face may
        leave no point to be found in the steps allowed: the answer is then the point that came
        closest, and the second value, in metres, says how close. Derivatives are those of the
        exact inverse.
        """
        if self.moves is None or not len(condition.moves):
            return x_c, jnp.zeros((), x_c.dtype)
        moves = jax.lax.stop_gradient(self.moves)
        nodes = moves.under(condition.moves.astype(moves.table.dtype))
        x, left, slope = _solve_carry(moves, *jax.lax.stop_gradient((nodes, x_c)))
        # Implicit function theorem: the value is zero, the derivative that of the inverse.
        missing = x_c - x - moves.read(nodes, x)
        x = x + _solve3(slope, missing - jax.lax.stop_gradient(missing))
        return x, jnp.sqrt(jnp.sum(left**2))

    def _moved(self, x: Float[Array, "3"], condition: LocalCondition) -> Float[Array, "3"]:
        """How far the expression moves a neutral point, metres."""
        if self.moves is None or not len(condition.moves):
            return jnp.zeros_like(x)
        moves = jax.lax.stop_gradient(self.moves)
        return moves.read(moves.under(condition.moves.astype(moves.table.dtype)), x)

    @property
    def batch_points(self) -> int:
        return 16_384

    def at(self, points: Float[Array, "N 3"]) -> HashPoints:
        features = jax.vmap(self._features)(points)
        width = self.encoding.width
        weight, bias = self.hidden[0], self.biases[0]
        first = jnp.matmul(features, weight[:, :width].T, precision=jax.lax.Precision.HIGHEST)
        return HashPoints(
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

    def __call__(self, x_c: Float[Array, "3"], condition: LocalCondition) -> GeometryValue:
        return self.carried_value(self.carried_from(x_c, condition)[0], condition)

    def carried_value(self, x: Float[Array, "3"], condition: LocalCondition) -> GeometryValue:
        joints, centres, fade, expression, _ = condition
        h = [self._features(x), _nearness(x, centres, fade) @ joints]
        if self.expressive is not None and len(expression):
            nodes = self.expressive.under(expression)
            h.append(self.expressive.read(nodes, x))
        h = jnp.concatenate(h)
        last = len(self.hidden) - 1
        for k, (weight, bias) in enumerate(zip(self.hidden, self.biases, strict=True)):
            h = weight[:, : len(h)] @ h + bias  # narrower, where expression is left out
            if k < last:
                h = softplus(h, self.sharpness)
        return GeometryValue(h[0])

    def faults(self) -> Iterator[tuple[str, str]]:
        """Leaves that do not fit one another: see `check_model`."""
        count, known = len(self.joints), self.expression_range.shape[-1]
        boxes = (len(self.detail_spacing), 3)
        yield from misshapen(self, joints=(None, 3), reach=(count,), pose_range=(2, count, 9))
        yield from misshapen(self, pose_weights=(count, 9, None), expression_range=(2, None))
        yield from misshapen(self, detail_low=boxes, detail_high=boxes)
        width = self.encoding.width + self.pose_weights.shape[-1]
        for name in ("expressive", "moves"):
            grid = getattr(self, name)
            if grid is not None and grid.table.shape[1] != known:
                yield f"{name}.table", f"shape {grid.table.shape}, expected (any, {known}, any)"
        if self.expressive is not None:
            width += self.expressive.table.shape[-1]
        for k, (weight, bias) in enumerate(zip(self.hidden, self.biases, strict=True)):
            if weight.shape != (len(bias), width):
                yield f"hidden[{k}]", f"shape {weight.shape}, expected {(len(bias), width)}"
            width = len(bias)

    def _features(self, x: Float[Array, "3"]) -> Float[Array, " width"]:
        return (self.encoding(x) * self._level_mask(x)[:, None]).reshape(-1)

    def _around_joints(self, dtype: Any) -> tuple[Float[Array, "J 3"], Float[Array, " J"]]:
        """Around where each joint's condition acts, and how it fades: see `_nearness`."""
        joints, reach = jax.lax.stop_gradient((self.joints, self.reach))
        return joints.astype(dtype), -0.5 / reach.astype(dtype) ** 2

    def _level_mask(self, x: Float[Array, "3"]) -> Float[Array, " levels"]:
        """1 for levels read at `x`, falling to 0 over the last two centimetres of a box."""
        spacing = np.asarray(self.encoding.spacing)
        mask = jnp.asarray(spacing >= self.trunk_spacing * 0.999, x.dtype)
        boxes = jax.lax.stop_gradient((self.detail_low, self.detail_high))
        lows, highs = (corner.astype(x.dtype) for corner in boxes)
        for low, high, finest in zip(lows, highs, self.detail_spacing, strict=True):  # few boxes
            depth = jnp.minimum(x - low, high - x).min()
            inside = jnp.clip(depth / 0.02, 0, 1)
            mask = jnp.maximum(mask, inside * jnp.asarray(spacing >= finest * 0.999, x.dtype))
        return mask


class HashPoints(AbstractPointCache):
    """A hash field: of its grids only what the first layer makes of them is kept.

    For each condition there remain a product with the points' nearness to the joints and the
    small network.
    """

    first: Float[Array, "N width"]
    nearness: Float[Array, "N J"]
    expressive: Float[Array, "N E K2"] | None
    points: Float[Array, "N 3"]
    moves: Float[Array, "N E 3"] | None
    from_condition: Float[Array, "width K1"]
    hidden: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    sharpness: float = eqx.field(static=True)

    def __call__(self, condition: Any) -> Float[Array, " N"]:
        joints, expression = condition.joints, condition.expression
        weight, width = self.from_condition, joints.shape[-1]
        h = self.first + _matmul(self.nearness, _matmul(joints, weight[:, :width].T))
        if self.expressive is not None:
            expressed = jnp.einsum("nek,e->nk", self.expressive, expression, precision=_EXACT)
            h = h + _matmul(expressed, weight[:, width:].T)
        for weight, bias in zip(self.hidden, self.biases, strict=True):
            h = _matmul(softplus(h, self.sharpness), weight.T) + bias
        return h[:, 0]

    def carried(self, condition: Any) -> Float[Array, "N 3"]:
        if self.moves is None:
            return self.points
        moved = jnp.einsum("nek,e->nk", self.moves, condition.moves, precision=_EXACT)
        return self.points + moved


def _matmul(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=_EXACT)


def _solve_carry(
    moves: ExpressionGrid, nodes: Float[Array, "N 3"], x_c: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3 3"]]:
    """Solve `x + moves(x) = x_c` by Newton steps, each halved until it gains.

    Returns the solution, what is missing there, and the derivative of the left side.
    """

    def evaluate(x: Float[Array, "3"]) -> tuple[Array, Array]:
        moved, slope = moves.read_with_jacobian(nodes, x)
        return x_c - x - moved, jnp.eye(3, dtype=x.dtype) + slope

    def unfinished(state: tuple) -> Any:
        k, _, left, *_ = state
        return (k < _CARRY_STEPS) & (jnp.sum(left**2) > _CARRY_TOLERANCE**2)

    def attempt(state: tuple) -> tuple:
        k, x, left, slope, step = state
        tried = x + step
        new_left, new_slope = evaluate(tried)
        gained = jnp.sum(new_left**2) < jnp.sum(left**2)
        newton = _newton_step(new_slope, new_left)
        return (
            k + 1,
            jnp.where(gained, tried, x),
            jnp.where(gained, new_left, left),
            jnp.where(gained, new_slope, slope),
            jnp.where(gained, newton, 0.5 * step),
        )

    left, slope = evaluate(x_c)
    state = (jnp.zeros((), jnp.int32), x_c, left, slope, _newton_step(slope, left))
    _, x, left, slope, _ = jax.lax.while_loop(unfinished, attempt, state)
    return x, left, slope


def _newton_step(slope: Float[Array, "3 3"], left: Float[Array, "3"]) -> Float[Array, "3"]:
    step = _solve3(slope, left)
    return step * jnp.minimum(1, _LARGEST_STEP / (jnp.sqrt(jnp.sum(step**2)) + 1e-9))


def _solve3(a: Float[Array, "3 3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Solve a 3 x 3 system by Cramer's rule; a determinant near zero is taken as 0.05."""
    # Written out: a batch of small LAPACK calls takes many times as long on a CPU.
    (p, q, r), (s, t, u), (v, w, z) = ((a[k, 0], a[k, 1], a[k, 2]) for k in range(3))
    adjugate = (
        (t * z - u * w, r * w - q * z, q * u - r * t),
        (u * v - s * z, p * z - r * v, r * s - p * u),
        (s * w - t * v, q * v - p * w, p * t - q * s),
    )
    determinant = p * adjugate[0][0] + q * adjugate[1][0] + r * adjugate[2][0]
    least = jnp.where(determinant < 0, -0.05, 0.05).astype(a.dtype)
    determinant = jnp.where(jnp.abs(determinant) < 0.05, least, determinant)
    return jnp.stack([k * b[0] + l * b[1] + m * b[2] for k, l, m in adjugate]) / determinant


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
    keys: Array, fan_in: tuple[int, ...], fan_out: tuple[int, ...]
) -> tuple[Float[Array, "_ _"], ...]:
    return tuple(
        jax.random.normal(k, (m, n)) * np.sqrt(2 / n)
        for k, n, m in zip(keys, fan_in, fan_out, strict=True)
    )


def _joint_reach(
    tree: KinematicTree, joints: Float[np.ndarray, "J 3"], least: float = 0.012, most: float = 0.15
) -> Float[np.ndarray, " J"]:
    """Half the mean length of the bones that meet at each joint, metres, within bounds."""
    lengths: list[list[float]] = [[] for _ in range(tree.num_joints)]
    for joint, parent in enumerate(tree.parents):
        if parent >= 0:
            length = float(np.linalg.norm(joints[joint] - joints[parent]))
            lengths[joint].append(length)
            lengths[parent].append(length)
    means = [np.mean(group) if group else most for group in lengths]
    return np.clip(0.5 * np.array(means), least, most)
