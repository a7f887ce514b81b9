"""Work in blocks against the same work at once."""

import numpy as np
import pytest

from xavatar_jax.meshing.sampler import in_blocks


@pytest.mark.parametrize("count", [0, 1, 4, 5, 23])
def test_blocks_give_what_all_rows_give(rng, count):
    points = rng.normal(size=(count, 3))
    seen = []

    def work(rows):
        seen.append(len(points[rows]))
        return points[rows] ** 2, points[rows].sum(axis=1)

    squares, sums = in_blocks(work, count, 4)
    np.testing.assert_array_equal(squares, points**2)
    np.testing.assert_array_equal(sums, points.sum(axis=1))
    assert sum(seen) == count
    assert max(seen) <= 4
    assert len(seen) == max(-(-count // 4), 1)


def test_an_error_in_a_block_is_raised():
    def work(rows):
        if rows.start == 8:
            raise ValueError("the third block")
        return (np.zeros(rows.stop - rows.start),)

    with pytest.raises(ValueError, match="the third block"):
        in_blocks(work, 20, 4)
