"""Part labels from weights and joint names."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TREES

from xavatar_jax.body import STANDARD_PARTS, Group, Part, Parts, derive_part_labels, standard_parts
from xavatar_jax.fields import GridSpacing, body_part_grids, grid_vertices
from xavatar_jax.kinematics import KinematicTree

BODY, FACE, LEFT_HAND, RIGHT_HAND, EYES_MOUTH = range(5)  # as files and metrics number them


def weights_of(tree, *rows):
    out = np.zeros((len(rows), tree.num_joints))
    for k, row in enumerate(rows):
        for name, weight in row.items():
            out[k, tree.index(name)] = weight
    return out


def test_the_parts_and_their_numbers():
    parts = standard_parts(TREES["smplx"], [0, 1, 2, 3, 4, 0, 3])
    assert parts.names == ("body", "face", "left_hand", "right_hand", "eyes_mouth")
    assert [parts.index(name) for name in parts.names] == [0, 1, 2, 3, 4]
    assert parts.members("face") == (FACE, EYES_MOUTH)
    assert parts.members("hands") == (LEFT_HAND, RIGHT_HAND)
    assert parts.members("left_hand") == (LEFT_HAND,)
    assert parts.members("eyes_mouth") == (EYES_MOUTH,)
    assert parts.regions == {"hands": ((2,), (3,)), "face": ((1, 4),)}
    assert [tuple(piece) for piece in parts.pieces] == [
        ("left_hand", "hands", (2,)), ("right_hand", "hands", (3,)), ("face", "face", (1, 4)),
    ]  # fmt: skip
    np.testing.assert_array_equal(parts.rows("hands"), [2, 3, 6])
    np.testing.assert_array_equal(parts.mask("face"), [0, 1, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(parts.densities, [1, 5, 8, 8, 5])
    with pytest.raises(KeyError, match="no part 'tail'; the parts are body, face"):
        parts.mask("tail")
    with pytest.raises(ValueError, match="part labels must be 0 to 4, found 0 to 5"):
        parts.with_labels([0, 5])


def test_parts_are_static_but_for_their_labels():
    """One program for two bodies of the same parts; another table is another program."""
    traces = []

    @jax.jit
    def count(parts):
        traces.append(parts.names)
        return jnp.sum(parts.labels == 0)

    parts = standard_parts(TREES["smplx"], [0, 1, 0])
    assert int(count(parts)) == 2
    assert int(count(parts.with_labels([0, 1, 1]))) == 1
    assert len(traces) == 1
    count(Parts(parts.labels, (Part("all"),)))
    assert len(traces) == 2


def test_cell_sizes_by_part_and_on_the_head():
    tree = TREES["smplx"]
    weights = weights_of(
        tree, {"spine3": 1.0}, {"head": 0.6, "neck": 0.4}, {"jaw": 1.0}, {"left_index1": 1.0}
    )
    parts = standard_parts(tree, [0, 0, 1, 2])
    sizes = parts.cell_sizes(tree, weights)
    np.testing.assert_array_equal(sizes, [0.008, 0.004, 0.002, 0.002])
    sizes = parts.cell_sizes(tree, weights, {"body": 0.01, "head": 0.005, "hands": 0.001})
    np.testing.assert_array_equal(sizes, [0.01, 0.005, 0.002, 0.001])


def test_a_body_may_bring_its_own_parts(bundled_body):
    """A tail on the body's left hand: its own name, starts, density and fine grid."""
    tail = Part("tail", "tail", "hands", "hand", density=3.0, starts=Group((20,), (25,)))
    labels = np.where(bundled_body.parts.mask("left_hand"), 1, 0)
    parts = Parts(labels.astype(np.int8), (STANDARD_PARTS[0], tail))
    assert parts.regions == {"hands": ((1,),), "face": ()}
    body = replace(bundled_body, parts=parts)
    assert body.part_labels.sum() == bundled_body.parts.mask("left_hand").sum()
    grids = body_part_grids(body, grid_vertices(body), GridSpacing(0.05, 0.03, 0.03))
    assert len(grids.spacing) == 2  # the coarse grid and the tail's
    tree = KinematicTree(("root", "tip"), (-1, 0))
    assert standard_parts(tree, [0]).table[0].starts == Group((0, 1))


def test_vertices_of_smplx():
    cases = [
        ({"spine3": 1.0}, BODY),
        ({"left_elbow": 0.6, "left_wrist": 0.4}, BODY),
        ({"left_elbow": 0.4, "left_wrist": 0.3, "left_ring2": 0.3}, LEFT_HAND),
        ({"right_thumb3": 1.0}, RIGHT_HAND),
        ({"neck": 0.7, "head": 0.3}, BODY),
        ({"neck": 0.3, "head": 0.7}, FACE),
        ({"jaw": 0.95, "head": 0.05}, FACE),
        ({"jaw": 0.5, "head": 0.5}, EYES_MOUTH),
        ({"left_eye": 1.0}, EYES_MOUTH),
        ({"right_eye": 0.6, "head": 0.4}, EYES_MOUTH),
    ]
    tree = TREES["smplx"]
    found = derive_part_labels(tree, weights_of(tree, *(row for row, _ in cases)))
    assert found.dtype == np.int8
    assert list(found) == [label for _, label in cases]


@pytest.mark.parametrize("kind", ["smpl", "smplh", "mano"])
def test_other_trees(kind):
    tree = TREES[kind]
    labels = derive_part_labels(tree, np.eye(tree.num_joints))
    for joint, name in enumerate(tree.names):
        side = "left" if "left" in name else "right"
        hand = {"left": LEFT_HAND, "right": RIGHT_HAND}[side]
        wrists = tree.indices(f"{side}_wrist")
        if wrists and joint in tree.subtree(wrists[0]):
            assert labels[joint] == hand
        else:
            assert labels[joint] == (FACE if name == "head" else BODY)


def test_labels_of_the_bundled_body_agree_with_its_weights(bundled_body):
    """The file's own hands and face are among those derived from weights, but for the borders."""
    derived = derive_part_labels(bundled_body.tree, np.asarray(bundled_body.weights))
    stored = np.asarray(bundled_body.part_labels)
    hands, face = (bundled_body.parts.mask(name) for name in ("hands", "face"))
    assert (stored == derived)[hands].mean() > 0.9
    assert bundled_body.parts.with_labels(derived).mask("face")[face].mean() > 0.8
