"""Poses in which a body touches itself, and posed points with all their canonical points.

The canonical points are found independently of the library's searches: points throughout the body
are posed, and Newton's method starts from those that end up close to a given posed point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from search_problems import carry

import xavatar_jax as xa
from xavatar_jax.body import BodyModel, canonical_joints
from xavatar_jax.correspondence import MIN_DETERMINANT, pair_rows
from xavatar_jax.fields import AbstractSkinningField, PartGrids, skin_with_jacobian
from xavatar_jax.geometry import vertex_normals
from xavatar_jax.kinematics import determinant_3x3, skin_points, solve_3x3
from xavatar_jax.sampling import signed_distance

NEAR_PART_M = 0.03  # a point this close to two parts uses the starts of both
OUTSIDE_M = 0.01  # canonical points further outside the body are ignored
APART_M = 0.02  # minimum distance of two distinct canonical points
TOUCHING_M = 0.004
LEAST_POINTS = 10  # minimum for meaningful statistics
PRESSED_M = 0.003  # indentation of the skin on each side of a contact


class Contact(NamedTuple):
    """Q posed points with up to R canonical points each (`known`), their labels and nearest parts.

    `upright` marks known points where the map preserves orientation. Between strongly bent fingers
    it turns space inside out; such points solve the equations but do not belong to the body.
    """

    name: str
    x_d: Float[np.ndarray, "Q 3"]
    x_c: Float[np.ndarray, "Q R 3"]
    known: Bool[np.ndarray, "Q R"]
    upright: Bool[np.ndarray, "Q R"]
    label: Int[np.ndarray, " Q"]
    pair_row: Int[np.ndarray, " Q"]
    transforms: Float[Array, "J 4 4"]


def contact_poses(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], names: Sequence[str]
) -> dict[str, xa.BodyParams]:
    """Poses for hand on thigh, palms together and fists, by least squares on a few vertices."""
    joints = np.asarray(canonical_joints(body, jnp.zeros(0)))
    normals = vertex_normals(vertices, np.asarray(body.faces))
    labels = np.asarray(body.part_labels)
    index = body.tree.index
    joint = lambda name: joints[index(name)]  # noqa: E731

    def facing(place: np.ndarray, direction: int, sign: int, part: int) -> int:
        """Index of the vertex of a part closest to `place` whose normal points along an axis."""
        fits = (labels == part) & (sign * normals[:, direction] > 0.6)
        return int(np.where(fits, np.linalg.norm(vertices - place, axis=1), np.inf).argmin())

    def palm(side: str) -> list[int]:
        """Vertices at the centre of a palm, towards the fingers and the thumb; palms face down."""
        part = body.parts.index(f"{side}_hand")
        wrist, knuckle = joint(f"{side}_wrist"), joint(f"{side}_middle1")
        centre = 0.4 * wrist + 0.6 * knuckle
        places = (centre, knuckle, centre + np.array([0, 0, 0.02]))
        return [facing(place, 1, -1, part) for place in places]

    def pads(side: str) -> tuple[list[int], list[int]]:
        """Vertices of four fingertips, and their targets on the palm."""
        part = body.parts.index(f"{side}_hand")
        wrist, tips, goals = joint(f"{side}_wrist"), [], []
        for finger in ("index", "middle", "ring", "pinky"):
            first, last = joint(f"{side}_{finger}1"), joint(f"{side}_{finger}3")
            tips.append(facing(last + 0.15 * (last - first), 1, -1, part))
            goals.append(facing(0.25 * wrist + 0.75 * first, 1, -1, part))
        return tips, goals

    hip, knee = joint("left_hip"), joint("left_knee")
    along, middle = (knee - hip) / np.linalg.norm(knee - hip), 0.45 * hip + 0.55 * knee
    front = [0, 0, 0.08]
    thigh = [
        facing(middle + front + step, 2, 1, 0)
        for step in (np.zeros(3), 0.05 * along, np.array([-0.03, 0, 0]))
    ]
    left, right = palm("left"), palm("right")
    arms = lambda side: [f"{side}_{n}" for n in ("collar", "shoulder", "elbow", "wrist")]  # noqa: E731
    start = np.zeros((body.num_joints, 3))
    sitting = start.copy()
    sitting[index("left_hip")] = [-1.2, 0, 0]
    fists, fingers, tips, goals = start.copy(), [], [], []
    for side, turn in (("left", -1.2), ("right", 1.2)):
        for finger in ("index", "middle", "ring", "pinky"):
            fingers += [f"{side}_{finger}{k}" for k in (1, 2, 3)]
        for name in fingers[-12:]:
            fists[index(name)] = [0, 0, turn]
        ends, places = pads(side)
        tips, goals = tips + ends, goals + places
    reach = _Reach(body, vertices)
    poses = {
        "hand on thigh": (arms("left"), sitting, left, thigh),
        "palms together": ([*arms("left"), *arms("right")], start, left, right),
        "fists": (fingers, fists, tips, goals),
    }
    return {name: reach(*poses[name]) for name in names}


class _Reach(NamedTuple):
    body: BodyModel
    vertices: np.ndarray

    def __call__(
        self, moving: list[str], pose: np.ndarray, these: list[int], those: list[int]
    ) -> xa.BodyParams:
        """Rotate joints until vertices meet, with a penalty on the rotations."""
        from scipy.optimize import least_squares

        rows = np.array([*these, *those])
        joints = np.array([self.body.tree.index(name) for name in moving])
        normals = vertex_normals(self.vertices, np.asarray(self.body.faces))[rows]
        place = jnp.asarray(self.vertices[rows] - PRESSED_M * normals, jnp.float32)
        weights = jnp.asarray(self.body.weights)[rows]
        first = pose[joints].ravel()

        @jax.jit
        def residual(turn: Array) -> Array:
            turned = jnp.asarray(pose).at[joints].set(turn.reshape(-1, 3))
            transforms = xa.bone_transforms(self.body, xa.BodyParams.create(self.body, pose=turned))
            posed = skin_points(place, weights, transforms)
            gap = (posed[: len(these)] - posed[len(these) :]).ravel()
            return jnp.concatenate([gap, 0.003 * (turn - first)])

        slope = jax.jit(jax.jacfwd(residual))

        def plain(fn: Callable[[Array], Array]) -> Callable[[np.ndarray], np.ndarray]:
            return lambda v: np.asarray(fn(jnp.asarray(v, jnp.float32)), np.float64)

        found = least_squares(
            plain(residual),
            first + 1e-3,
            jac=plain(slope),  # pyright: ignore[reportArgumentType]
            max_nfev=40,
        )
        solved = pose.copy()
        solved[joints] = found.x.reshape(-1, 3)
        return xa.BodyParams.create(self.body, pose=solved)


def inner_nodes(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], grids: PartGrids
) -> list[Float[np.ndarray, "N 3"]]:
    """Nodes of each grid inside the body or just outside."""
    nodes = np.asarray(grids.nodes, np.float64)
    sizes = np.asarray(grids.spacing)
    # Nodes are stored grid by grid.
    cells = np.asarray(grids.cells)
    dense = np.append(np.asarray(grids.offset), len(np.asarray(grids.index)))
    own = []
    for g in range(len(sizes)):
        used = np.unique(cells[np.asarray(grids.index)[dense[g] : dense[g + 1]]])
        inside = signed_distance(vertices, np.asarray(body.faces), nodes[used]) > -OUTSIDE_M
        own.append(nodes[used[inside]].astype(np.float32))
    return own


@eqx.filter_jit
def _newton(
    field: AbstractSkinningField, start: Array, target: Array, transforms: Array
) -> tuple[Array, Array, Array]:
    """Thirty Newton steps from each start: points, residuals and determinants."""

    def one(args: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        start, target = args

        def step(x: Array, _: Any) -> tuple[Array, None]:
            posed, jacobian, _ = skin_with_jacobian(field, x, transforms)
            move = solve_3x3(jacobian, posed - target)
            length = jnp.linalg.norm(move)
            return x - move * jnp.minimum(1.0, 0.02 / jnp.maximum(length, 1e-9)), None

        x, _ = jax.lax.scan(step, start, length=30)
        posed, jacobian, _ = skin_with_jacobian(field, x, transforms)
        return x, jnp.linalg.norm(posed - target), determinant_3x3(jacobian)

    return jax.lax.map(one, (start, target), batch_size=4096)


def contact_points(
    name: str,
    params: xa.BodyParams,
    body: BodyModel,
    field: AbstractSkinningField,
    vertices: Float[np.ndarray, "V 3"],
    nodes: list[Float[np.ndarray, "N 3"]],
    *,
    count: int,
    seed: int,
) -> Contact:
    """Posed points of a hand that coincide with other canonical points, and all of those.

    **Raises:** `ValueError` if the pose has too few such points.
    """
    from scipy.spatial import KDTree

    rng = np.random.default_rng([seed, 2])
    transforms = jnp.asarray(xa.bone_transforms(body, params), jnp.float32)
    labels = np.asarray(body.part_labels)
    hand = rng.choice(body.parts.rows("left_hand"), 60 * count)
    own = (vertices[hand] + 0.004 * rng.standard_normal((len(hand), 3))).astype(np.float32)
    posed = np.asarray(carry(field, jnp.asarray(own), transforms))
    trees = [KDTree(np.asarray(carry(field, jnp.asarray(n), transforms))) for n in nodes]
    # In contact: some posed node is close, but far away in canonical space.
    touching = np.zeros(len(own), bool)
    for canonical, tree in zip(nodes, trees, strict=True):
        gap, near = tree.query(posed, k=12, distance_upper_bound=2 * TOUCHING_M)
        there = canonical[np.minimum(near, len(canonical) - 1)]
        away = np.linalg.norm(there - own[:, None], axis=-1) > APART_M
        touching |= (np.isfinite(gap) & away).any(1)
    rows = np.flatnonzero(touching)[: 3 * count]
    posed = posed[rows]
    starts, targets = [], []
    for canonical, tree in zip(nodes, trees, strict=True):
        gap, near = tree.query(posed, k=8, distance_upper_bound=0.02)
        # Fill up with the nearest node, so that arrays keep their shape.
        near = np.where(np.isfinite(gap), near, np.asarray(tree.query(posed)[1])[:, None])
        starts.append(canonical[near])
        targets.append(np.repeat(posed[:, None], 8, 1))
    start, target = np.concatenate(starts, 1), np.concatenate(targets, 1)
    x, residual, det = (
        np.asarray(v).reshape(*start.shape[:2], *v.shape[1:])
        for v in _newton(
            field,
            jnp.asarray(start.reshape(-1, 3)),
            jnp.asarray(target.reshape(-1, 3)),
            transforms,
        )
    )
    good = (residual < 2e-6) & (np.abs(det) >= MIN_DETERMINANT)
    flat = np.flatnonzero(good)
    depth = signed_distance(
        vertices, np.asarray(body.faces), x.reshape(-1, 3)[flat].astype(np.float64)
    )
    good.ravel()[flat] = depth > -OUTSIDE_M
    x_c, turned, known = _distinct(x, det, good)
    upright = known & (turned > 0)
    several = np.array([_spread(p[k]) > APART_M for p, k in zip(x_c, upright, strict=True)], bool)
    chosen = np.flatnonzero(several)[:count]
    if len(chosen) < LEAST_POINTS:
        raise ValueError(
            f"{name}: {len(chosen)} points of contact, expected {LEAST_POINTS} or more"
        )
    x_d = posed[chosen]
    surface = np.asarray(skin_points(jnp.asarray(vertices), jnp.asarray(body.weights), transforms))
    distance = np.stack(
        [
            KDTree(surface[labels == part]).query(x_d)[0]
            if (labels == part).any()
            else np.full(len(x_d), np.inf)
            for part in range(len(body.parts.table))
        ],
        axis=1,
    )
    order = np.argsort(distance, axis=1)[:, :2]
    close = np.take_along_axis(distance, order, 1)[:, 1] < NEAR_PART_M
    second = np.where(close, order[:, 1], order[:, 0])
    return Contact(
        name,
        x_d,
        x_c[chosen],
        known[chosen],
        upright[chosen],
        order[:, 0].astype(np.int32),
        pair_rows(len(body.parts.table))[order[:, 0], second].astype(np.int32),
        transforms,
    )


def _distinct(
    x: np.ndarray, det: np.ndarray, good: np.ndarray, most: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Up to `most` good and distinct candidates of `(Q, C, 3)`."""
    points, known = np.zeros((len(x), most, 3), np.float32), np.zeros((len(x), most), bool)
    turned = np.zeros((len(x), most), np.float32)
    for q in range(len(x)):
        kept: list[int] = []
        for c in np.flatnonzero(good[q]):
            if len(kept) < most and all(np.linalg.norm(x[q, c] - x[q, k]) > 1e-3 for k in kept):
                kept.append(int(c))
        points[q, : len(kept)], turned[q, : len(kept)] = x[q, kept], det[q, kept]
        known[q, : len(kept)] = True
    return points, turned, known


def _spread(points: np.ndarray) -> float:
    """Largest distance between any two points."""
    if len(points) < 2:
        return 0.0
    return float(np.linalg.norm(points[:, None] - points[None], axis=-1).max())


def root_shares(
    contact: Contact,
    search: Callable[[Array, Array, Array], tuple[np.ndarray, np.ndarray]],
    rows: Int[np.ndarray, " Q"],
    within_m: float = 1e-4,
) -> dict[str, float]:
    """Share of points with all roots found, and share of roots found."""
    x_c, valid = search(jnp.asarray(contact.x_d), jnp.asarray(rows), contact.transforms)
    gap = np.linalg.norm(contact.x_c[:, :, None] - x_c[:, None], axis=-1)
    found = np.where(valid[:, None], gap, np.inf).min(-1) < within_m
    return {
        "points": len(found),
        "roots_per_point": float(contact.upright.sum(1).mean()),
        "share_of_points_with_every_root": float((found | ~contact.upright).all(1).mean()),
        "share_of_roots": float(found[contact.upright].mean()),
        "inverted_roots_per_point": float((contact.known & ~contact.upright).sum(1).mean()),
        "share_of_points_with_inverted_roots_too": float((found | ~contact.known).all(1).mean()),
    }
