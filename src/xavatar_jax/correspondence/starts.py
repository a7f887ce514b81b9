"""Which bones start the search, by part."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int

from ..body import PARTS
from ..kinematics import KinematicTree

StartSet = Literal["part_aware", "body", "full"]

_LIMBS = (
    *("left_hip", "right_hip", "left_knee", "right_knee"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
)


def part_groups(tree: KinematicTree) -> Mapping[str, tuple[int, ...]]:
    """Bones that start the search of a point, by the point's part; and `full` for any point.

    On the SMPL family these are the groups of X-Avatar's released code: `body` is the root with
    hips, knees, shoulders and elbows, `face` the neck, head and jaw, a hand its wrist and fingers,
    `full` all of these and the eyes without the neck. On a tree with other names a group with no
    joint by these names takes every joint that belongs to no hand and no face.
    """

    def below(name: str) -> tuple[int, ...]:
        found = tree.indices(name)
        return tree.subtree(found[0]) if found else ()

    left, right = below("left_wrist"), below("right_wrist")
    face = tree.indices("neck", "head", "jaw")
    special = {*left, *right, *below("head"), *face}
    rest = tuple(j for j in range(tree.num_joints) if j not in special)
    limbs = tree.indices(*_LIMBS)
    body = (0, *limbs) if limbs else (rest or (0,))
    full = sorted({*body, *left, *right, *below("head")})
    groups = {
        "body": body,
        "face": face or body,
        "left_hand": left or body,
        "right_hand": right or body,
        "eyes_mouth": face or body,
        "full": tuple(full),
    }
    return MappingProxyType({name: tuple(sorted(set(group))) for name, group in groups.items()})


def start_table(
    tree: KinematicTree,
    starts: StartSet = "part_aware",
    groups: Mapping[str, tuple[int, ...]] | None = None,
) -> tuple[Int[np.ndarray, "parts I"], Bool[np.ndarray, "parts I"]]:
    """Start bones of each part, padded to one width, with a mask: `(bones, mask)`.

    `starts` is "part_aware" (each part its own bones), "body" (ablation A1) or "full" (A2) for
    every point. `groups` overrides some or all groups of `part_groups`.

    **Raises:** `ValueError` for an unknown part or start set, an empty group, or a bone out of
    range.
    """
    known = dict(part_groups(tree))
    for name, group in (groups or {}).items():
        if name not in known:
            raise ValueError(f"unknown part {name!r}; the parts are {', '.join(known)}")
        known[name] = tuple(group)
    if starts == "part_aware":
        rows = [known[part] for part in PARTS]
    elif starts in ("body", "full"):
        rows = [known[starts]] * len(PARTS)
    else:
        raise ValueError(f"unknown start set {starts!r}: part_aware, body or full")
    for part, row in zip(PARTS, rows, strict=True):
        check_bones(row, tree.num_joints, what=f"start bones of {part}")
    width = max(len(row) for row in rows)
    bones = np.zeros((len(PARTS), width), np.int32)
    mask = np.zeros((len(PARTS), width), bool)
    for k, row in enumerate(rows):
        bones[k, : len(row)] = row
        mask[k, : len(row)] = True
    return bones, mask


def check_bones(bones: tuple[int, ...], num_joints: int, *, what: str = "init_bones") -> None:
    """**Raises:** `ValueError` if there are none, or one is out of range."""
    if len(bones) == 0:
        raise ValueError(f"{what}: at least one bone must start the search")
    wrong = [b for b in bones if not 0 <= int(b) < num_joints]
    if wrong:
        raise ValueError(f"{what}: bone {wrong[0]} is out of range for {num_joints} joints")
