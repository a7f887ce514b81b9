"""Points drawn anew: where they go, that they are right, and that no clock has a say."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace

import jax
import numpy as np
import pytest
from xavatar_jax.training import Interrupted, loop, redraw
from xavatar_jax.training.redraw import Redraw, put_rows

import xavatar_jax as xa
from xavatar_jax.geometry import winding_number


@pytest.fixture(scope="module")
def rounds(case):
    """Two rounds of two of three frames, and the pool after each."""
    body, frames, config, fields, pool = case
    config = replace(config, redraw_every=3, redraw_frames=2)
    maker = Redraw(body, frames, np.zeros(10), config, fields.skinning)
    pools = [pool]
    for number in (1, 2):
        maker.begin(3 * number - 1)
        new = maker.take(number, fields.skinning)
        pools.append(put_rows(pools[-1], new, maker.rows(number)))
    assert [maker.round_at(k) for k in (0, 2, 3, 4, 9)] == [0, 0, 1, 0, 3]
    maker.close()
    return pools


def test_one_frame_after_another_gets_new_points(rounds):
    before, first, second = (np.asarray(p.points) for p in rounds)
    changed = [(a != b).any((1, 2)).tolist() for a, b in ((before, first), (first, second))]
    assert changed == [[True, True, False], [True, False, True]]
    assert (before != second).any((1, 2)).all()


def test_shapes_stay_so_that_nothing_compiles_again(rounds):
    kinds = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), p) for p in rounds]
    assert kinds[0] == kinds[1] == kinds[2]
    assert len({float(p.share) for p in rounds}) == 1


def test_new_points_are_labelled_and_have_roots(case, rounds):
    """In the frame of which the second round made the points."""
    _, frames, _, fields, _ = case
    pool, frame = rounds[2], frames[2]
    points, distance = np.asarray(pool.points[2], np.float64), np.asarray(pool.distance[2])
    inside = winding_number(frame.vertices, frame.faces, points) > 0.5
    clear = np.abs(distance) > 1e-3
    assert ((distance > 0) == inside)[clear].all()
    found = int(pool.found[2])
    assert found > 0.9 * len(points)
    bones = pool.transforms[2]
    move = jax.jit(jax.vmap(lambda x: xa.skin_points(x, fields.skinning(x), bones)))
    gap = np.linalg.norm(np.asarray(move(pool.root[2]))[:found] - points[:found], axis=1)
    # Two Newton steps from roots of the table, whose Jacobian they take.
    assert np.quantile(gap, 0.9) < 1e-4


@pytest.fixture
def fit(case, no_prefit, monkeypatch):
    """A short call of `fit` on the three frames, whose first points and roots are made already."""
    body, frames, config, _, pool = case
    monkeypatch.setattr(loop, "label_frames", lambda *_, **__: pool)
    monkeypatch.setattr(loop, "find_roots", lambda *_, **__: pool)
    config = replace(
        config, steps=8, report_every=1, redraw_every=3, redraw_frames=1, polish_every=5,
        validation=replace(config.validation, share=0.0),
    )  # fmt: skip
    return lambda frames=frames, **options: xa.fit(
        frames, config, body=body, verbose=False, **options
    )


def test_a_stopped_run_goes_on_bit_for_bit(fit, tmp_path, monkeypatch):
    """However long the thread takes: it is late each time in one run, and not in the other."""
    whole = fit()

    def slowly(*args, **options):
        time.sleep(0.5)
        return draw(*args, **options)

    def stop(k, fields, terms):
        if k == 4:
            os.kill(os.getpid(), signal.SIGINT)

    draw = redraw.draw_points
    monkeypatch.setattr(redraw, "draw_points", slowly)
    with pytest.raises(Interrupted, match="step 5 of 8"):
        fit(callback=stop, checkpoint=tmp_path / "run.npz")
    resumed = fit(checkpoint=tmp_path / "run.npz", resume=True)
    assert resumed.history.seconds["redraw"] > 0
    for a, b in zip(
        jax.tree.leaves(whole.avatar.fields), jax.tree.leaves(resumed.avatar.fields), strict=True
    ):
        assert np.array_equal(a, b)


def test_a_frame_that_cannot_be_read_is_named(fit, case):
    body, frames = case[:2]

    def load(i):
        raise ValueError(f"scan_{i}.ply: cannot be read")

    with pytest.raises(ValueError, match=r"scan_0\.ply: cannot be read"):
        fit(xa.Frames(frames.params, load, part_labels=np.asarray(body.part_labels)))
