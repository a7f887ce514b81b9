"""Where the search starts, by part: at single bones, and at joints between two."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations
from types import MappingProxyType
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..body import PARTS
from ..kinematics import KinematicTree, inverse_3x3

StartSet = Literal["part_aware", "paper", "full", "all_bones", "body"]
"""Starts of a point: of its part (our own groups, or the paper's), of all parts (ours, or the
paper's), or of the body."""

_Groups = Literal["part_aware", "paper"]
# Of which groups, and the one of them that every point takes if all take the same.
_CHOICES: dict[str, tuple[_Groups, str | None]] = {
    "part_aware": ("part_aware", None),
    "paper": ("paper", None),
    "full": ("part_aware", "full"),
    "all_bones": ("paper", "full"),
    "body": ("paper", "body"),
}

_LIMBS = (
    *("left_hip", "right_hip", "left_knee", "right_knee"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
)


def _pair_rows() -> Int[np.ndarray, "parts parts"]:
    rows = np.diag(np.arange(len(PARTS)))
    for k, (a, b) in enumerate(combinations(range(len(PARTS)), 2)):
        rows[a, b] = rows[b, a] = len(PARTS) + k
    return rows


PAIR_ROWS = _pair_rows()
"""Row of a start table made with pairs, for a point close to parts a and b: `PAIR_ROWS[a, b]`."""


class Group(NamedTuple):
    """Starts of one part, as indices of joints.

    - `bones`: a point is pulled back as if it moved with this bone alone.
    - `joints`: as if it moved half with the joint's bone and half with its parent's, which is
      where skin at the joint is.
    """

    bones: tuple[int, ...]
    joints: tuple[int, ...] = ()


class StartTable(eqx.Module):
    """Starts of each part, padded to one width.

    - `index`: `(parts, I)` a joint's own index for its bone, J more for the joint itself.
    - `mask`: `(parts, I)` false at padding.
    - `parents`: `(J,)`, the root its own.
    """

    index: Int[Array, "parts I"]
    mask: Bool[Array, "parts I"]
    parents: Int[Array, " J"]

    @property
    def width(self) -> int:
        """Starts a point, padding included."""
        return self.index.shape[1]


def part_groups(tree: KinematicTree, starts: _Groups = "part_aware") -> Mapping[str, Group]:
    """Starts for a point of each part, and `full` for a point of any.

    "paper" gives, on the SMPL family, the groups of X-Avatar's released code: `body` is the root
    with hips, knees, shoulders and elbows, `face` the neck, head and jaw, a hand its wrist and
    fingers, `full` all of these and the eyes without the neck. "part_aware" adds to them what they
    were measured to lose: to the body the feet and the neck, to the face the joints between neck,
    head and jaw, to a hand the joints of its fingers; `full` has all that a part has. A foot is an
    ankle's child, a finger what is below a wrist.

    On a tree with other names a group with no joint by these names takes every joint that belongs
    to no hand and no face.
    """

    def below(name: str) -> tuple[int, ...]:
        found = tree.indices(name)
        return tree.subtree(found[0]) if found else ()

    def children(name: str) -> tuple[int, ...]:
        found = tree.indices(name)
        return tree.children(found[0]) if found else ()

    left, right = below("left_wrist"), below("right_wrist")
    face = tree.indices("neck", "head", "jaw")
    special = {*left, *right, *below("head"), *face}
    rest = tuple(j for j in range(tree.num_joints) if j not in special)
    limbs = tree.indices(*_LIMBS)
    body = (0, *limbs) if limbs else (rest or (0,))
    every = {*body, *left, *right, *below("head")}
    own = starts == "part_aware"
    if own and limbs:
        body += (*children("left_ankle"), *children("right_ankle"), *tree.indices("neck"))
    body = _ordered(body)
    face_group = Group(_ordered(face), _ordered(face) if own else ()) if face else Group(body)

    def hand(bones: tuple[int, ...]) -> Group:
        # The first of a subtree is the wrist itself.
        return Group(_ordered(bones), _ordered(bones[1:]) if own else ()) if bones else Group(body)

    groups = {
        "body": Group(body),
        "face": face_group,
        "left_hand": hand(left),
        "right_hand": hand(right),
        "eyes_mouth": face_group,
    }
    if own:
        every |= {j for group in groups.values() for j in group.bones}
    joints = _ordered(j for group in groups.values() for j in group.joints)
    return MappingProxyType({**groups, "full": Group(_ordered(every), joints)})


def groups_by_part(
    tree: KinematicTree,
    starts: StartSet = "part_aware",
    groups: Mapping[str, Group | tuple[int, ...]] | None = None,
) -> dict[str, Group]:
    """The group that each of `PARTS` starts with; arguments and errors as of `start_table`."""
    if starts not in _CHOICES:
        raise ValueError(f"unknown start set {starts!r}: {', '.join(_CHOICES)}")
    of, one = _CHOICES[starts]
    known = dict(part_groups(tree, of))
    for name, group in (groups or {}).items():
        if name not in known:
            raise ValueError(f"unknown part {name!r}; the parts are {', '.join(known)}")
        known[name] = group if isinstance(group, Group) else Group(tuple(group))
    return {part: known[one or part] for part in PARTS}


def start_table(
    tree: KinematicTree,
    starts: StartSet = "part_aware",
    groups: Mapping[str, Group | tuple[int, ...]] | None = None,
    *,
    pairs: bool = False,
) -> StartTable:
    """The starts of each part as arrays, a row for each of `PARTS`.

    With `pairs` there are more rows, for points close to two parts, which take the starts of
    both: `PAIR_ROWS[a, b]` is the row of parts a and b.

    `starts` is "part_aware" (each part its own, the library's groups) or "paper" (X-Avatar's), or
    for every point the same: "full" (what any part has), "all_bones" (the paper's 45, ablation A2)
    or "body" (its nine, A1). `groups` overrides some or all of them; a plain tuple lists bones.

    **Raises:** `ValueError` for an unknown part or start set, an empty group, or a bone out of
    range.
    """
    rows = []
    for part, group in groups_by_part(tree, starts, groups).items():
        check_bones(group.bones, tree.num_joints, what=f"start bones of {part}")
        if group.joints:
            check_bones(group.joints, tree.num_joints, what=f"start joints of {part}")
        rows.append([*group.bones, *(tree.num_joints + j for j in group.joints)])
    if pairs:
        rows += [_ordered({*rows[a], *rows[b]}) for a, b in combinations(range(len(PARTS)), 2)]
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
    """Each point pulled back by every bone, then by every joint: K is 2 J."""
    upper = transforms[:, :3, :]
    upper = jnp.concatenate([upper, 0.5 * (upper + upper[starts.parents])])
    # Half way between opposite turns there is no inverse: a start that is not finite ends at once.
    linear = inverse_3x3(upper[..., :3])
    shift = -(linear * upper[:, None, :, 3]).sum(-1)
    # By all at once: one matrix product costs less than a gather of transforms for each point.
    moved = jnp.matmul(x_d, linear.reshape(-1, 3).T, precision=jax.lax.Precision.HIGHEST)
    return moved.reshape(len(x_d), -1, 3) + shift


def check_bones(bones: tuple[int, ...], num_joints: int, *, what: str = "init_bones") -> None:
    """**Raises:** `ValueError` if there are none, or one is out of range."""
    if len(bones) == 0:
        raise ValueError(f"{what}: at least one bone must start the search")
    wrong = [b for b in bones if not 0 <= int(b) < num_joints]
    if wrong:
        raise ValueError(f"{what}: bone {wrong[0]} is out of range for {num_joints} joints")


def _ordered(joints: Iterable[int]) -> tuple[int, ...]:
    return tuple(sorted(set(joints)))
