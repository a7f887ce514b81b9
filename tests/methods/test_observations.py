"""The frames that a run learns from: budgets, held-out frames, shapes, and bad frames."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.frames import frames_from_params
from xavatar_jax.learning import TrainingNotice
from xavatar_jax.methods.observations import (
    FrameCheck,
    check_expression,
    check_found,
    choose_frames,
    frame_digest,
    frames_digest,
    frames_in_budget,
    misfit,
    subject_betas,
    with_one_shape,
)


def sequences(lengths, body):
    """Frames of sequences of these lengths, in random poses."""
    rng = np.random.default_rng(3)
    pose = 0.2 * rng.standard_normal((sum(lengths), body.num_joints, 3))
    return frames_from_params(
        body,
        xa.BodyParams.create(body, pose=pose),
        sequence_names=[f"s{k}" for k in range(len(lengths))],
        sequence_index=np.repeat(np.arange(len(lengths)), lengths),
    )


def choose(frames, train_frames=0, minutes=None, share=0.1, held=12, notices=None):
    return choose_frames(
        frames, train_frames=train_frames, minutes=minutes, per_minute=60, held_share=share,
        held_frames=held, notices=notices,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("minutes", "train_frames", "expected"),
    [(None, 200, 200), (None, 0, 0), (1.5, 200, 30), (4.0, 200, 180), (60.0, 200, 200),
     (2.0, 0, 60), (0.0, 200, 24), (1.0, 10, 10)],
)  # fmt: skip
def test_frames_in_a_budget(minutes, train_frames, expected):
    assert frames_in_budget(train_frames, minutes, 60) == expected
    assert frames_in_budget(train_frames, minutes, 0) == train_frames


def test_frames_that_are_left_out_are_reported(family):
    notices = []
    with pytest.warns(TrainingNotice, match=r"from 24 of 27 frames: .* of the 0\.5 minutes"):
        learned, held = choose(sequences([30], family["smplx"]), 200, 0.5, notices=notices)
    assert (len(learned), len(held)) == (24, 3)
    assert len(notices) == 1


def test_the_last_tenth_of_each_sequence_is_held_out(family):
    learned, held = choose(sequences([30, 9, 10, 25], family["smplx"]), held=100)
    assert list(held) == [27, 28, 29, 48, 72, 73]
    assert sorted([*learned, *held]) == list(range(74))


def test_held_frames_that_are_not_used_are_not_learned_from(family):
    learned, held = choose(sequences([100, 100], family["smplx"]), held=4)
    assert len(held) == 4
    assert sum(90 <= k < 100 for k in held) == 2
    assert len(learned) == 180
    assert not set(learned) & {*range(90, 100), *range(190, 200)}


@pytest.mark.parametrize("off", [{"share": 0.0}, {"held": 0}])
def test_no_validation(family, off):
    learned, held = choose(sequences([40], family["smplx"]), **off)
    assert len(learned) == 40
    assert not len(held)


def test_varied_frames_come_from_those_that_are_not_held_out(family):
    learned, held = choose(sequences([40], family["smplx"]), train_frames=6)
    assert len(learned) == 6
    assert max(learned) < 36
    assert list(held) == [36, 37, 38, 39]


def test_one_person_has_one_shape(family, rng):
    frames = sequences([3], family["smplx"])
    betas = rng.normal(size=(3, 10)).astype(np.float32)
    frames = frames.with_params(replace(frames.params, betas=betas), frames.body)
    mean = subject_betas(frames)
    np.testing.assert_allclose(mean, betas.mean(0), rtol=1e-5, atol=1e-6)
    notices = []
    with pytest.warns(TrainingNotice, match=r"betas differ between frames by up to \d"):
        one = with_one_shape(frames, mean, notices)
    np.testing.assert_allclose(one.params.betas, np.tile(mean, (3, 1)), rtol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with_one_shape(one, mean, notices)
    assert len(notices) == 1


@pytest.mark.parametrize(("metres", "fits"), [(0.02, True), (0.2, False)])
def test_frames_that_do_not_fit_are_named(toy_body, metres, fits):
    frame = frames_from_params(toy_body, xa.BodyParams.zeros(toy_body, (1,)))[0]
    params = frame.params
    moved = xa.Frames.from_meshes(
        [(frame.vertices + np.array([metres, 0, 0]), frame.faces)],
        xa.BodyParams.zeros(toy_body, (1,)), sources=["scan_0"], body=toy_body,
    )[0]  # fmt: skip
    assert params.pose.shape == moved.params.pose.shape
    assert misfit(toy_body, frame) < 1e-5
    check = FrameCheck(toy_body)
    check.add(frame)
    check.add(moved)
    if fits:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check.report([])
    else:
        with pytest.warns(TrainingNotice, match=r"1 of 2 frames do not fit.*scan_0 \(\d+\.\d cm"):
            check.report([])


def test_many_misfits_are_counted_and_the_worst_are_listed(toy_body):
    found = [(f"f{k}", 0.01 * k) for k in range(12)]
    with pytest.warns(TrainingNotice, match=r"12 of 40 .* f11 \(11\.0 cm\).*f4 .* and 4 more\."):
        FrameCheck(toy_body, misfits=found, seen=40).report([])


def test_expression_that_no_field_reads_is_reported(family):
    params = sequences([3], family["smplx"]).params
    more = np.zeros((3, 50), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_expression(params, None)
        check_expression(replace(params, expression=more), None)
    more[1, 12] = -2.5
    with pytest.warns(TrainingNotice, match=r"50 coefficients.*first 10.*reach 2\.5"):
        check_expression(replace(params, expression=more), None)


def test_points_without_roots_are_counted():
    names = ("a", "b", "c")
    check_found(names, np.array([100, 95, 90]), 100, None)
    kept = []
    with pytest.warns(TrainingNotice, match="30% of the points could not be mapped"):
        check_found(names, np.array([70, 70, 70]), 100, kept)
    assert len(kept) == 1
    with pytest.warns(TrainingNotice, match=r"1 of 3 frames have no point .*: b\."):
        check_found(names, np.array([100, 0, 100]), 100, None)
    with pytest.raises(ValueError, match=r"no point of any frame.*a, b, c.*units"):
        check_found(names, np.zeros(3, int), 100, None)


def test_digests_tell_meshes_parameters_and_shapes_apart(family):
    frames = sequences([2], family["smplx"])
    meshes = [frame_digest(f) for f in frames]
    betas = np.zeros(10)
    known = frames_digest(frames.params, betas, meshes)
    assert meshes[0] != meshes[1]
    assert known == frames_digest(frames.params, betas, [frame_digest(f) for f in frames])
    turned = replace(frames.params, pose=frames.params.pose.at[1, 4, 0].add(0.1))
    others = [(turned, betas, meshes), (frames.params, betas + 1, meshes),
              (frames.params, betas, meshes[::-1])]  # fmt: skip
    assert len({known, *(frames_digest(*other) for other in others)}) == 4
