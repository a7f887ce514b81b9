"""Where the search starts: bones and joints by part, and the parts that a point is close to."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..body import BodyModel, Group, Parts, standard_parts
from ..kinematics import KinematicTree, inverse_3x3

StartSet = Literal["part_aware", "paper", "full", "all_bones", "body"]
"""Starts of a point: those of its part (this library's or the paper's), of all parts (this
library's or the paper's), or of the body."""

# Whether the paper's groups are used, and the part whose group every point takes, if any.
_CHOICES: dict[str, tuple[bool, str | None]] = {
    "part_aware": (False, None),
    "paper": (True, None),
    "full": (False, "full"),
    "all_bones": (True, "full"),
    "body": (True, "body"),
}


def pair_rows(num_parts: int) -> Int[np.ndarray, "parts parts"]:
    """Rows of a start table made with `pairs`: `[a, b]` for a point close to parts a and b."""
    rows = np.diag(np.arange(num_parts, dtype=np.int32))
    for k, (a, b) in enumerate(combinations(range(num_parts), 2)):
        rows[a, b] = rows[b, a] = num_parts + k
    return rows


class StartTable(eqx.Module):
    """Starts of each part, padded to one width.

    - `index`: `(parts, I)` j for the bone of joint j, J + j for the joint itself.
    - `mask`: `(parts, I)` false at padding.
    - `parents`: `(J,)`; the root is its own parent.
    """

    index: Int[Array, "parts I"]
    mask: Bool[Array, "parts I"]
    parents: Int[Array, " J"]

    @property
    def width(self) -> int:
        """Starts per point, padding included."""
        return self.index.shape[1]


def groups_by_part(
    body: BodyModel | KinematicTree,
    starts: StartSet = "part_aware",
    groups: Mapping[str, Group | tuple[int, ...]] | None = None,
) -> dict[str, Group]:
    """The group of each part, in label order; arguments and errors as for `start_table`."""
    if starts not in _CHOICES:
        raise ValueError(f"unknown start set {starts!r}: {', '.join(_CHOICES)}")
    paper, one = _CHOICES[starts]
    parts = standard_parts(body, ()) if isinstance(body, KinematicTree) else body.parts
    known = {p.name: p.paper_starts if paper else p.starts for p in parts.table}
    known["full"] = parts.paper_all_starts if paper else parts.all_starts
    for name, group in (groups or {}).items():
        if name not in known:
            raise ValueError(f"unknown part {name!r}; the parts are {', '.join(known)}")
        known[name] = group if isinstance(group, Group) else Group(tuple(group))
    return {name: known[one or name] for name in parts.names}


def start_table(
    body: BodyModel | KinematicTree,
    starts: StartSet = "part_aware",
    groups: Mapping[str, Group | tuple[int, ...]] | None = None,
    *,
    pairs: bool = False,
) -> StartTable:
    """The starts of each part of a body as arrays, one row per part label.

    With `pairs` there are further rows for points close to two parts, with the starts of both;
    see `pair_rows`. A bare tree has the standard parts.

    `starts` is "part_aware" (this library's groups for each part) or "paper" (X-Avatar's), or the
    same group for every point: "full" (the starts of all parts), "all_bones" (the paper's 45,
    ablation A2) or "body" (its nine, A1). `groups` replaces some or all of them; a plain tuple
    lists bones.

    **Raises:** `ValueError` for an unknown part or start set, an empty group, or a bone out of
    range.
    """
    tree = body if isinstance(body, KinematicTree) else body.tree
    rows: list[list[int]] = []
    for part, group in groups_by_part(body, starts, groups).items():
        check_bones(group.bones, tree.num_joints, what=f"start bones of {part}")
        if group.joints:
            check_bones(group.joints, tree.num_joints, what=f"start joints of {part}")
        rows.append([*group.bones, *(tree.num_joints + j for j in group.joints)])
    if pairs:
        rows += [sorted({*a, *b}) for a, b in combinations(rows, 2)]
    width = max(len(row) for row in rows)
    index = np.zeros((len(rows), width), np.int32)
    mask = np.zeros((len(rows), width), bool)
    for k, row in enumerate(rows):
        index[k, : len(row)] = row
        mask[k, : len(row)] = True
    parents = np.maximum(np.asarray(tree.parents, np.int32), 0)
    return StartTable(jnp.asarray(index), jnp.asarray(mask), jnp.asarray(parents))


def pull_back_all(
    x_d: Float[Array, "P 3"], transforms: Float[Array, "J 4 4"], starts: StartTable
) -> Float[Array, "P K 3"]:
    """Each point pulled back by every bone, then by every joint; K is 2 J."""
    upper = transforms[:, :3, :]
    upper = jnp.concatenate([upper, 0.5 * (upper + upper[starts.parents])])
    # Halfway between opposite turns there is no inverse; a start that is not finite ends at once.
    linear = inverse_3x3(upper[..., :3])
    shift = -(linear * upper[:, None, :, 3]).sum(-1)
    # One matrix product is cheaper than gathering transforms for each point.
    moved = jnp.matmul(x_d, linear.reshape(-1, 3).T, precision=jax.lax.Precision.HIGHEST)
    return moved.reshape(len(x_d), -1, 3) + shift


def check_bones(bones: tuple[int, ...], num_joints: int, *, what: str = "init_bones") -> None:
    """**Raises:** `ValueError` if there are none, or one is out of range."""
    if len(bones) == 0:
        raise ValueError(f"{what}: at least one bone must start the search")
    wrong = [b for b in bones if not 0 <= int(b) < num_joints]
    if wrong:
        raise ValueError(f"{what}: bone {wrong[0]} is out of range for {num_joints} joints")


NEAR = 0.03
"""Metres: a point this close to two parts may belong to either, or to both where they touch."""


class RowFinder:
    """Start rows for points without labels, for a start table made with `pairs`.

    A point takes the part of the nearest posed vertex, or the pair of parts if a vertex of another
    piece is within `near` metres, so that there is no seam where labels change.
    """

    def __init__(
        self, vertices: Float[np.ndarray, "V 3"], parts: Parts, *, near: float = NEAR
    ) -> None:
        from scipy.spatial import cKDTree

        self._near, self._pairs = near, pair_rows(len(parts.table))
        # Unbalanced, uncompacted trees are faster to build and as fast to query on surfaces.
        options: dict[str, Any] = {"balanced_tree": False, "compact_nodes": False}
        self._all = cKDTree(vertices, **options)
        # Parts of one piece (the face, and eyes and mouth) start alike: no pair of them is needed.
        first = np.arange(len(parts.table))
        for piece in parts.pieces:
            first[list(piece.labels)] = piece.labels[0]
        self._labels = first[np.asarray(parts.labels)]
        self._parts = [cKDTree(vertices[self._labels == k], **options) for k in range(len(first))]

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
        points = np.asarray(points, np.float64)
        # Other points get some row; the search reports them.
        finite = np.isfinite(points).all(axis=-1)
        first = np.zeros(len(points), np.int32)
        first[finite] = self._labels[self._all.query(points[finite], workers=-1)[1]]
        second, best = first.copy(), np.full(len(points), np.inf)
        for part, tree in enumerate(self._parts):
            rows = np.flatnonzero(finite & (first != part))
            if not tree.n or not len(rows):
                continue
            away = tree.query(points[rows], distance_upper_bound=self._near, workers=-1)[0]
            closer = away < best[rows]
            second[rows[closer]], best[rows[closer]] = part, away[closer]
        return self._pairs[first, second].astype(np.int32)
