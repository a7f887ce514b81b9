"""Start bones by part: the published groups on SMPL-X, sensible ones on any other tree."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TREES, refused

from xavatar_jax.body import STANDARD_PARTS, Group, Part, Parts, part_groups
from xavatar_jax.correspondence import check_bones, pair_rows, start_table
from xavatar_jax.correspondence.starts import pull_back_all
from xavatar_jax.kinematics import KinematicTree, axis_angle_to_matrix

BODY = (0, 1, 2, 4, 5, 16, 17, 18, 19)
FACE = (12, 15, 22)
LEFT = (20, *range(25, 40))
RIGHT = (21, *range(40, 55))
FULL = (0, 1, 2, 4, 5, 15, 16, 17, 18, 19, *range(20, 55))


FEET = (10, 11)
NECK = (12,)


def bones(groups):
    return {part: group.bones for part, group in groups.items()}


def test_paper_groups_of_smplx_are_the_published_ones():
    groups = part_groups(TREES["smplx"], "paper")
    assert bones(groups) == {
        "body": BODY, "face": FACE, "left_hand": LEFT, "right_hand": RIGHT,
        "eyes_mouth": FACE, "full": FULL,
    }  # fmt: skip
    assert not any(group.joints for group in groups.values())
    assert len(groups["full"].bones) == 45
    assert len(BODY) == 9


def test_own_groups_of_smplx_hold_the_published_ones():
    groups = part_groups(TREES["smplx"])
    assert groups["body"] == Group(tuple(sorted({*BODY, *FEET, *NECK})))
    assert groups["face"] == groups["eyes_mouth"] == Group(FACE, FACE)
    assert groups["left_hand"] == Group(LEFT, tuple(range(25, 40)))
    assert groups["right_hand"] == Group(RIGHT, tuple(range(40, 55)))
    every = tuple(sorted({*FULL, *FEET, *NECK}))
    assert groups["full"] == Group(every, (*FACE, *range(25, 55)))


def test_groups_of_smpl_and_mano():
    assert part_groups(TREES["smpl"], "paper")["body"].bones == BODY
    assert part_groups(TREES["smplh"])["left_hand"].bones == (20, *range(22, 37))
    mano = part_groups(TREES["mano"])
    assert mano["full"].bones == tuple(range(16))
    assert mano["right_hand"].bones == tuple(range(16))


def test_a_tree_with_other_names_falls_back_to_all_it_has():
    tree = KinematicTree(("root", "a", "b", "c"), (-1, 0, 1, 0))
    groups = part_groups(tree)
    assert all(group == Group((0, 1, 2, 3)) for group in groups.values())
    table = start_table(tree)
    assert table.mask.all()
    np.testing.assert_array_equal(table.index, np.tile(np.arange(4), (len(STANDARD_PARTS), 1)))


def rows(table):
    return [
        tuple(np.asarray(i)[np.asarray(m)]) for i, m in zip(table.index, table.mask, strict=True)
    ]


@pytest.mark.parametrize("kind", TREES)
@pytest.mark.parametrize(
    ("starts", "of", "one"),
    [
        ("part_aware", "part_aware", None),
        ("paper", "paper", None),
        ("full", "part_aware", "full"),
        ("all_bones", "paper", "full"),
        ("body", "paper", "body"),
    ],
)
def test_the_table_lists_each_parts_group(kind, starts, of, one):
    tree = TREES[kind]
    table = start_table(tree, starts)
    groups = part_groups(tree, of)
    assert table.index.shape == table.mask.shape == (len(STANDARD_PARTS), table.width)
    for row, part in zip(rows(table), STANDARD_PARTS, strict=True):
        group = groups[one or part.name]
        assert row == (*group.bones, *(tree.num_joints + j for j in group.joints))
    # The padding too.
    assert ((table.index >= 0) & (table.index < 2 * tree.num_joints)).all()


def test_a_pair_of_parts_takes_the_starts_of_both():
    table = start_table(TREES["smplx"], "paper", pairs=True)
    found = rows(table)
    assert len(found) == 15
    pairs = pair_rows(5)
    for a in range(5):
        assert pairs[a, a] == a
        for b in range(5):
            assert pairs[a, b] == pairs[b, a]
            assert found[pairs[a, b]] == tuple(sorted({*found[a], *found[b]}))
    assert sorted(np.unique(pairs)) == list(range(15))


def test_groups_may_be_overridden():
    tree = TREES["smplx"]
    table = start_table(tree, "paper", groups={"face": (15, 22, 23, 24)})
    assert rows(table)[1] == (15, 22, 23, 24)
    assert rows(table)[0] == BODY
    jaw = start_table(tree, groups={"face": Group((22,), joints=(22,))})
    assert rows(jaw)[1] == (22, 55 + 22)
    with pytest.raises(ValueError, match=r"unknown part 'tail'; the parts are body"):
        start_table(tree, groups={"tail": (1,)})
    with pytest.raises(ValueError, match=r"start bones of face: at least one bone"):
        start_table(tree, groups={"face": ()})
    with pytest.raises(ValueError, match=r"start bones of body: bone 55 is out of range for 55"):
        start_table(tree, groups={"body": (0, 55)})
    with pytest.raises(ValueError, match=r"start joints of body: bone 55 is out of range for 55"):
        start_table(tree, groups={"body": Group((0,), joints=(55,))})
    with refused(r"unknown start set 'all'"):
        start_table(tree, "all")  # pyright: ignore[reportArgumentType]


def test_a_body_with_its_own_parts_starts_where_they_say(family):
    """A body of a trunk and a tail: two rows, their pair, and the paper's groups apart."""
    tree = KinematicTree(("root", "tail1", "tail2"), (-1, 0, 1))
    table = (
        Part("trunk", starts=Group((0,)), paper_starts=Group((0, 1))),
        Part("tail", starts=Group((1, 2), (2,)), paper_starts=Group((2,))),
    )
    parts = Parts(np.zeros(0, np.int8), table, all_starts=Group((0, 1, 2)))
    body = replace(family["smpl"], tree=tree, parts=parts)
    assert rows(start_table(body, pairs=True)) == [(0,), (1, 2, 5), (0, 1, 2, 5)]
    assert rows(start_table(body, "paper")) == [(0, 1), (2,)]
    assert rows(start_table(body, "full")) == [(0, 1, 2)] * 2
    np.testing.assert_array_equal(pair_rows(2), [[0, 2], [2, 1]])


def test_starts_undo_one_bone_or_half_of_two(rng):
    """Against LAPACK's inverses."""
    tree = KinematicTree(("root", "a", "b"), (-1, 0, 1))
    turns = axis_angle_to_matrix(jnp.asarray(rng.normal(scale=0.4, size=(3, 3))))
    transforms = np.tile(np.eye(4), (3, 1, 1))
    transforms[:, :3, :3] = turns
    transforms[:, :3, 3] = rng.normal(size=(3, 3))
    x = rng.normal(size=(5, 3))
    halves = 0.5 * (transforms + transforms[[0, 0, 1]])
    expected = [
        [(np.linalg.inv(t) @ np.append(p, 1))[:3] for t in (*transforms, *halves)] for p in x
    ]
    found = pull_back_all(
        jnp.asarray(x, jnp.float32), jnp.asarray(transforms, jnp.float32), start_table(tree)
    )
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_bones_are_checked():
    check_bones((0, 3), 4)
    with pytest.raises(ValueError, match="init_bones: at least one"):
        check_bones((), 4)
    with pytest.raises(ValueError, match="bone 4 is out of range for 4 joints"):
        check_bones((0, 4), 4)
