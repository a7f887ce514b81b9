"""The parts of a body: vertex labels, and the settings that differ between parts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8

from ..kinematics import KinematicTree

Region = Literal["hands", "face"]

_LIMBS = (
    *("left_hip", "right_hip", "left_knee", "right_knee"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
)


class Group(NamedTuple):
    """Starts of the search for a point, as joint indices.

    - `bones`: the inverse transform of the bone gives the start.
    - `joints`: the inverse of the mean transform of the joint's bone and its parent's, as for
      skin at the joint.
    """

    bones: tuple[int, ...]
    joints: tuple[int, ...] = ()


@dataclass(frozen=True)
class Part:
    """One part of a body.

    - `piece`: connected parts with the same piece share a fine grid, a box in overlap metrics and
      a picture. Default: the part's name.
    - `region`: "hands" or "face", whose options and metrics apply; None for the rest of the body.
    - `sampled_as`: the field of `SamplingPlan` that gives the number of points.
    - `density`: points per area in the fit to the mean shape, relative to the body.
    - `cell`: edge of extraction cells, metres. `cell_below` lists joints with another edge, for
      vertices that mostly move with the joint or its descendants.
    - `starts`, `paper_starts`: starts of the search, in this library and in X-Avatar's code.
    """

    name: str
    piece: str = ""
    region: Region | None = None
    sampled_as: str = "body"
    density: float = 1.0
    cell: float = 0.008
    cell_below: tuple[tuple[str, float], ...] = ()
    starts: Group = Group(())
    paper_starts: Group = Group(())


class Piece(NamedTuple):
    """A connected piece of a region: its name, region and part labels."""

    name: str
    region: Region
    labels: tuple[int, ...]


STANDARD_PARTS = (
    Part("body", cell_below=(("head", 0.004),)),
    Part("face", "face", "face", "face", density=5.0, cell=0.002),
    Part("left_hand", "left_hand", "hands", "hand", density=8.0, cell=0.002),
    Part("right_hand", "right_hand", "hands", "hand", density=8.0, cell=0.002),
    Part("eyes_mouth", "face", "face", "eyes_mouth", density=5.0, cell=0.002),
)
"""The parts of the SMPL family, without starts, which depend on the tree."""


class Parts(eqx.Module):
    """Part labels of a mesh and the table of its parts. Only the labels are not static.

    Label 0 is the rest of the body. Methods take names of parts, pieces or regions and use NumPy,
    outside `jit`.

    - `labels`: `(V,)`, indices into `table`.
    - `all_starts`, `paper_all_starts`: starts for a point of any part.
    """

    labels: Int8[np.ndarray, " V"] | Int8[Array, " V"]
    table: tuple[Part, ...] = eqx.field(static=True, default=STANDARD_PARTS)
    all_starts: Group = eqx.field(static=True, default=Group(()))
    paper_all_starts: Group = eqx.field(static=True, default=Group(()))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts in label order."""
        return tuple(part.name for part in self.table)

    @property
    def pieces(self) -> tuple[Piece, ...]:
        """The pieces of all regions, hands first in the SMPL family."""
        found: dict[tuple[Region, str], list[int]] = {}
        for label, part in enumerate(self.table):
            if part.region is not None:
                found.setdefault((part.region, part.piece or part.name), []).append(label)
        order = sorted(found.items(), key=lambda item: (item[0][0] == "face", item[1]))
        return tuple(Piece(name, region, tuple(labels)) for (region, name), labels in order)

    @property
    def regions(self) -> dict[Region, tuple[tuple[int, ...], ...]]:
        """Part labels of each piece of "hands" and of "face"."""
        regions: tuple[Region, ...] = ("hands", "face")
        return {r: tuple(p.labels for p in self.pieces if p.region == r) for r in regions}

    @property
    def densities(self) -> Float[np.ndarray, " parts"]:
        """`density` of each part, indexed by label."""
        return np.array([part.density for part in self.table])

    def index(self, name: str) -> int:
        """Label of a part. **Raises:** `KeyError` listing the parts."""
        if name not in self.names:
            raise KeyError(f"no part {name!r}; the parts are {', '.join(self.names)}")
        return self.names.index(name)

    def members(self, name: str) -> tuple[int, ...]:
        """Labels of the region, else piece, else part of this name. **Raises:** `KeyError`."""
        for of in (lambda p: p.region, lambda p: p.piece or p.name):
            found = tuple(label for label, part in enumerate(self.table) if of(part) == name)
            if found:
                return found
        return (self.index(name),)

    def mask(self, name: str) -> Bool[np.ndarray, " V"]:
        """Whether each vertex belongs to a region, piece or part."""
        return np.isin(np.asarray(self.labels), self.members(name))

    def rows(self, name: str) -> Int[np.ndarray, " n"]:
        """Indices of the vertices of a region, piece or part."""
        return np.flatnonzero(self.mask(name))

    def in_region(self) -> Bool[np.ndarray, " parts"]:
        """Whether each part belongs to a region, indexed by label."""
        return np.array([part.region is not None for part in self.table])

    def with_labels(self, labels: Any) -> Parts:
        """The same parts for another mesh. **Raises:** `ValueError` for an unknown label."""
        labels = np.asarray(labels)
        if labels.size and not 0 <= labels.min() <= labels.max() < len(self.table):
            raise ValueError(
                f"part labels must be 0 to {len(self.table) - 1}, found {labels.min()} to "
                f"{labels.max()}"
            )
        return replace(self, labels=labels.astype(np.int8))

    def cell_sizes(
        self,
        tree: KinematicTree,
        weights: Float[np.ndarray, "V J"],
        sizes: Mapping[str, float] = MappingProxyType({}),
    ) -> Float[np.ndarray, " V"]:
        """Edge of the extraction cells at each vertex, metres.

        `sizes` overrides the edges of the parts, by region ("body" for parts without one) or by
        joint of `cell_below`.
        """
        labels = np.asarray(self.labels)
        found = np.array([sizes.get(p.region or "body", p.cell) for p in self.table])[labels]
        for label, part in enumerate(self.table):
            for joint, size in part.cell_below:
                below = (labels == label) & (_mass(tree, weights, joint) > 0.5)
                found[below] = sizes.get(joint, size)
        return found


def standard_parts(tree: KinematicTree, labels: Any) -> Parts:
    """The parts of the SMPL family on any tree, found by joint name; see `part_groups`."""
    own, paper = part_groups(tree), part_groups(tree, "paper")
    table = tuple(
        replace(part, starts=own[part.name], paper_starts=paper[part.name])
        for part in STANDARD_PARTS
    )
    empty = Parts(np.zeros(0, np.int8), table, own["full"], paper["full"])
    return empty.with_labels(labels)


def part_groups(
    tree: KinematicTree, starts: Literal["part_aware", "paper"] = "part_aware"
) -> Mapping[str, Group]:
    """Starts of the search for each part of the SMPL family, and `full` for any point.

    "paper" gives the groups of X-Avatar's released code: `body` is the root with hips, knees,
    shoulders and elbows; `face` the neck, head and jaw; a hand its wrist and fingers; `full` all
    of these and the eyes, without the neck. "part_aware" adds starts for roots that these groups
    miss: feet and neck for the body, the joints between neck, head and jaw for the face, the
    finger joints for a hand; `full` has the starts of every part.

    If the tree has no joint of a group, the group has the joints outside hands and face.
    """

    def below(name: str) -> tuple[int, ...]:
        return tuple(k for j in tree.indices(name) for k in tree.subtree(j))

    def children(name: str) -> tuple[int, ...]:
        return tuple(k for j in tree.indices(name) for k in tree.children(j))

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
        # The first joint of the subtree is the wrist itself.
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


def derive_part_labels(
    tree: KinematicTree, weights: Float[np.ndarray, "V J"]
) -> Int8[np.ndarray, " V"]:
    """Labels of the standard parts from skinning weights, for models without labels.

    A vertex belongs to a hand (or to the face) if most of its weight is on the wrist (or the head)
    and the joints below. Within the face, vertices that mostly move with an eye, and those that
    partly move with the jaw (the lips), are `eyes_mouth`. All others are `body`.
    """
    names = [part.name for part in STANDARD_PARTS]
    labels = np.zeros(len(weights), np.int8)
    face, jaw = _mass(tree, weights, "head") > 0.5, _mass(tree, weights, "jaw")
    eyes = np.maximum(_mass(tree, weights, "left_eye"), _mass(tree, weights, "right_eye"))
    labels[face] = names.index("face")
    lips = (jaw > 0.1) & (jaw < 0.9)
    labels[face & ((eyes > 0.5) | lips)] = names.index("eyes_mouth")
    for side in ("left", "right"):
        hand = _mass(tree, weights, f"{side}_wrist") > 0.5
        labels[hand] = names.index(f"{side}_hand")
    return labels


def _mass(tree: KinematicTree, weights: Any, joint: str) -> Float[np.ndarray, " V"]:
    """Weight of each vertex on a joint and those below; zero if the tree lacks the joint."""
    found = tree.indices(joint)
    weights = np.asarray(weights)
    return weights[:, tree.subtree(found[0])].sum(1) if found else np.zeros(len(weights))


def _ordered(joints: Iterable[int]) -> tuple[int, ...]:
    return tuple(sorted(set(joints)))
