"""Part labels from weights and joint names."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import TREES

from xavatar_jax.body import (
    BODY,
    EYES_MOUTH,
    FACE,
    FACES,
    HANDS,
    LEFT_HAND,
    PARTS,
    RIGHT_HAND,
    derive_part_labels,
)


def weights_of(tree, *rows):
    out = np.zeros((len(rows), tree.num_joints))
    for k, row in enumerate(rows):
        for name, weight in row.items():
            out[k, tree.index(name)] = weight
    return out


def test_the_parts_and_their_numbers():
    assert PARTS == ("body", "face", "left_hand", "right_hand", "eyes_mouth")
    assert (BODY, FACE, LEFT_HAND, RIGHT_HAND, EYES_MOUTH) == (0, 1, 2, 3, 4)
    assert FACES == (FACE, EYES_MOUTH)
    assert HANDS == (LEFT_HAND, RIGHT_HAND)


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
    assert (stored == derived)[np.isin(stored, HANDS)].mean() > 0.9
    assert np.isin(derived[np.isin(stored, FACES)], FACES).mean() > 0.8
