"""Start rows of unlabelled points, against distances computed one by one."""

from __future__ import annotations

import numpy as np

from xavatar_jax.body import STANDARD_PARTS, Parts
from xavatar_jax.correspondence import RowFinder, pair_rows

PAIRS = pair_rows(len(STANDARD_PARTS))


def parts(labels):
    return Parts(np.zeros(0, np.int8)).with_labels(labels)


def test_rows_are_of_the_nearest_part_and_of_another_close_by(rng):
    vertices = rng.uniform(-0.05, 0.05, (30, 3))
    labels = rng.integers(0, 4, 30)  # no vertex of the last part
    points = np.concatenate([rng.uniform(-0.08, 0.08, (200, 3)), [[5.0, 5.0, 5.0]]])
    rows = RowFinder(vertices, parts(labels))(points)
    away = np.linalg.norm(points[:, None] - vertices[None], axis=-1)
    both = 0
    for k, row in enumerate(rows):
        by_part = np.array(
            [away[k, labels == p].min(initial=np.inf) for p in range(len(STANDARD_PARTS))]
        )
        order = np.argsort(by_part)
        second = order[1] if by_part[order[1]] <= 0.03 else order[0]
        both += second != order[0]
        assert row == PAIRS[order[0], second]
    assert 10 < both < 190


def test_eyes_and_mouth_take_no_place_beside_the_face():
    """A fingertip at the cheek: the hand is the second part, though the lips are nearer."""
    body, face, left, _, lips = range(len(STANDARD_PARTS))
    vertices = np.array([[0.0, 0, 0], [0.005, 0, 0], [0.01, 0, 0], [0.5, 0, 0]])
    finder = RowFinder(vertices, parts([face, lips, left, body]))
    assert finder(np.array([[0.0, 0, 0.001]])).tolist() == [PAIRS[face, left]]


def test_points_that_are_not_finite_get_some_row():
    finder = RowFinder(np.eye(3), parts([0, 1, 2]))
    rows = finder(np.array([[np.nan, 0, 0], [0, 0, 1.0]]))
    assert rows.tolist() == [0, 2]
