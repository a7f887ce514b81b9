"""Start bones by part: the published groups on SMPL-X, sensible ones on any other tree."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import TREES

from xavatar_jax.body import PARTS
from xavatar_jax.correspondence import check_bones, part_groups, start_table
from xavatar_jax.kinematics import KinematicTree

BODY = (0, 1, 2, 4, 5, 16, 17, 18, 19)
FACE = (12, 15, 22)
LEFT = (20, *range(25, 40))
RIGHT = (21, *range(40, 55))
FULL = (0, 1, 2, 4, 5, 15, 16, 17, 18, 19, *range(20, 55))


def test_groups_of_smplx_are_the_published_ones():
    groups = part_groups(TREES["smplx"])
    assert dict(groups) == {
        "body": BODY, "face": FACE, "left_hand": LEFT, "right_hand": RIGHT,
        "eyes_mouth": FACE, "full": FULL,
    }  # fmt: skip
    assert len(groups["full"]) == 45
    assert len(BODY) == 9


def test_groups_of_smpl_and_mano():
    assert part_groups(TREES["smpl"])["body"] == BODY
    assert part_groups(TREES["smplh"])["left_hand"] == (20, *range(22, 37))
    mano = part_groups(TREES["mano"])
    assert mano["full"] == tuple(range(16))
    assert mano["right_hand"] == tuple(range(16))


def test_a_tree_with_other_names_falls_back_to_all_it_has():
    tree = KinematicTree(("root", "a", "b", "c"), (-1, 0, 1, 0))
    groups = part_groups(tree)
    assert all(group == (0, 1, 2, 3) for group in groups.values())
    bones, mask = start_table(tree)
    assert mask.all()
    np.testing.assert_array_equal(bones, np.tile(np.arange(4), (len(PARTS), 1)))


@pytest.mark.parametrize("kind", TREES)
@pytest.mark.parametrize("starts", ["part_aware", "body", "full"])
def test_the_table_lists_each_parts_group(kind, starts):
    tree = TREES[kind]
    bones, mask = start_table(tree, starts)
    groups = part_groups(tree)
    assert bones.shape == mask.shape
    for row, part in enumerate(PARTS):
        expected = groups[part if starts == "part_aware" else starts]
        assert tuple(bones[row][mask[row]]) == expected
    assert ((bones >= 0) & (bones < tree.num_joints)).all()  # the padding too


def test_groups_may_be_overridden():
    bones, mask = start_table(TREES["smplx"], groups={"face": (15, 22, 23, 24)})
    assert tuple(bones[1][mask[1]]) == (15, 22, 23, 24)
    assert tuple(bones[0][mask[0]]) == BODY
    with pytest.raises(ValueError, match=r"unknown part 'tail'; the parts are body"):
        start_table(TREES["smplx"], groups={"tail": (1,)})
    with pytest.raises(ValueError, match=r"start bones of face: at least one bone"):
        start_table(TREES["smplx"], groups={"face": ()})
    with pytest.raises(ValueError, match=r"start bones of body: bone 55 is out of range for 55"):
        start_table(TREES["smplx"], groups={"body": (0, 55)})
    with pytest.raises(ValueError, match=r"unknown start set 'all'"):
        start_table(TREES["smplx"], "all")  # pyright: ignore[reportArgumentType]


def test_bones_are_checked():
    check_bones((0, 3), 4)
    with pytest.raises(ValueError, match="init_bones: at least one"):
        check_bones((), 4)
    with pytest.raises(ValueError, match="bone 4 is out of range for 4 joints"):
        check_bones((0, 4), 4)
