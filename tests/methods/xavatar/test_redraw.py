"""Points drawn again during a run: which frames, with correct labels and roots, at fixed steps."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from small_runs import labelled, same, with_roots

import xavatar_jax as xa
from xavatar_jax.fields import grids_for_search
from xavatar_jax.methods.xavatar.upkeep import Redraw


@pytest.fixture(scope="module")
def rounds(case):
    """The data before, and after two rounds of two of three frames; and what was asked for."""
    skinning, asked = case.model.skinning, []
    grids = grids_for_search(skinning, case.body, np.zeros(10), case.config.search.grid)
    # Points of another seed, which the rounds share out.
    config = replace(case.config, points=replace(case.config.points, sigma=(0.004, 0.013)))
    _, other = with_roots(case.body, case.model, labelled(case.body, case.frames, config), config)

    def make(rows, number):
        asked.append((rows.tolist(), number))
        take = lambda leaf: leaf[np.asarray(rows)] if leaf.ndim else leaf  # noqa: E731
        return jax.tree.map(take, other)

    redraw = Redraw(make, grids, every=3, frames=2, learned=3, rounds=2)
    redraw.begin(0)
    found = [case.data]
    for step in (3, 6, 9):
        found.append(redraw(case.model, found[-1], step))
    redraw.close()
    return found, asked


def test_frames_take_turns_and_rounds_end(rounds):
    (before, first, second, third), asked = rounds
    assert asked == [([0, 1], 1), ([2, 0], 2)]
    changed = [
        (np.asarray(a.samples.x_d) != np.asarray(b.samples.x_d)).any((1, 2)).tolist()
        for a, b in ((before, first), (first, second))
    ]
    assert changed[0] == [True, True, False]
    assert changed[1][1:] == [False, True]
    assert same(second, third)


def test_shapes_stay_so_that_nothing_compiles_again(rounds):
    kinds = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), data) for data in rounds[0]]
    assert all(kind == kinds[0] for kind in kinds)
    assert len({float(data.roots.share) for data in rounds[0]}) == 1


def test_a_frame_that_cannot_be_read_is_named(case):
    """In a run: the first points are read, and those of the first round are not."""
    reads = []

    def load(i):
        reads.append(i)
        if len(reads) > 3:
            raise ValueError(f"scan_{i}.ply: cannot be read")
        return case.frames[i].vertices, case.frames[i].faces

    frames = xa.Frames(case.frames.params, load, part_labels=np.asarray(case.body.part_labels))
    config = replace(
        case.config, steps=4, redraw_every=2, redraw_frames=1,
        validation=replace(case.config.validation, share=0.0),
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"scan_0\.ply: cannot be read"):
        case.fit(frames, config)
