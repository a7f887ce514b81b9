"""Frames that are wrong, poor or few: what is reported, and what is learned from them."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.learning import TrainingNotice


def with_meshes(frames, change):
    """The same parameters with each mesh `(vertices, faces)` changed by its number."""
    meshes = [change(k, f.vertices, f.faces) for k, f in enumerate(frames)]
    names = [f"scan_{k}" for k in range(len(meshes))]
    return xa.Frames.from_meshes(meshes, frames.params, sources=names)


def shifted(frames, metres, rows=(0, 1, 2)):
    """Some meshes far from their parameters."""
    return with_meshes(frames, lambda k, v, f: (v + np.array([metres * (k in rows), 0, 0]), f))


def test_what_was_reported_is_in_the_history_and_reported_once(case, tmp_path):
    """Also of a run that is resumed."""
    wrong = with_meshes(
        case.frames, lambda k, v, f: (v + 0.2 * (k == 1), f[:, ::-1] if k != 1 else f)
    )
    config = replace(case.config, steps=2)
    path = tmp_path / "run.npz"
    with pytest.warns(TrainingNotice) as said:
        done = case.fit(wrong, config, checkpoint=path)
    messages = list(dict.fromkeys(str(w.message) for w in said))
    assert done.history.notices == messages
    assert any("1 of 3 frames do not fit" in m and "scan_1" in m for m in messages)
    assert any("2 of 3 meshes were inside out" in m for m in messages)
    again = case.fit(wrong, config, checkpoint=path, resume=True)
    assert again.history.notices == messages


def test_a_single_frame(case):
    done = case.fit(case.frames[:1])
    assert done.history.steps_done == case.config.steps
    assert done.history.validation == []
    assert len(done.frames) == 1
    assert all(np.isfinite(values).all() for values in done.history.terms.values())


def test_a_frame_far_from_its_parameters_is_named_and_not_learned_from(case):
    config = replace(case.config, steps=2, report_every=1)
    losses = []
    for metres in (5.0, 50.0):
        with pytest.warns(TrainingNotice) as said:
            done = case.fit(shifted(case.frames, metres, (1,)), config)
        words = "1 of 3 frames have no point that could be mapped"
        assert any(words in str(w.message) and "scan_1" in str(w.message) for w in said)
        losses.append(done.history.terms["occupancy"])
    np.testing.assert_array_equal(*losses)  # NaN where the other stage took the step


def test_frames_that_are_all_far_from_their_parameters_are_refused(case):
    with (
        pytest.warns(TrainingNotice, match="do not fit"),
        pytest.raises(ValueError, match=r"no point of any frame.*scan_0, scan_1, scan_2.*units"),
    ):
        case.fit(shifted(case.frames, 5.0))


def test_frames_of_another_body_are_refused(case):
    params = eqx.tree_at(lambda p: p.betas, case.frames.params, jnp.zeros((3, 40)))
    wrong = xa.Frames(params, lambda i: (case.frames[i].vertices, case.frames[i].faces))
    with pytest.raises(ValueError, match=r"frames\.params\.betas has shape \(3, 40\)"):
        case.fit(wrong)


@pytest.mark.parametrize("minutes", [0, -1.0, float("nan")])
def test_budgets_are_positive(case, minutes):
    with pytest.raises(ValueError, match="minutes must be a positive number"):
        case.fit(config=replace(case.config, minutes=minutes))
