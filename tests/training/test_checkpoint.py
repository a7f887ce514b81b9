"""Runs that are stopped and go on: the numbers of one that was not, and refusals."""

from __future__ import annotations

import json
import os
import shutil
import signal
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import posed_frames

import xavatar_jax as xa
from xavatar_jax.files import flatten_named, load_arrays, save_arrays
from xavatar_jax.training import (
    Interrupted,
    TrainingError,
    TrainingNotice,
    choose_frames,
    loop,
    read_log,
)
from xavatar_jax.training import step as step_module
from xavatar_jax.training.loop import train_pool
from xavatar_jax.training.pool import find_roots, label_frames
from xavatar_jax.training.progress import progress


def same(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@pytest.fixture(scope="module")
def job(case, no_prefit):
    """A call of `fit` on 12 frames, judged by one, whose points are drawn and searched once."""
    body, _, config, fields, _ = case
    config = replace(
        config, train_frames=2, report_every=2, polish_every=5, checkpoint_every=4,
        validation=replace(config.validation, every=3, points=128),
    )  # fmt: skip
    frames = posed_frames(body, 12)
    chosen = frames[np.concatenate(choose_frames(frames, config))]
    with progress("", 4, verbose=False) as bar:
        pool = label_frames(body, chosen, config, bar=bar)
        pool = find_roots(body, np.zeros(10), fields.skinning, pool, config, bar=bar)

    def call(frames=frames, config=config, **options):
        return xa.fit(frames, config, body=body, verbose=False, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "label_frames", lambda *_, **__: pool)
        patch.setattr(loop, "find_roots", lambda *_, **__: pool)
        yield call, frames, config


@pytest.fixture(scope="module")
def whole(job, tmp_path_factory):
    """The job done without a stop, the folder of its files, and its fields by step."""
    folder = tmp_path_factory.mktemp("whole")
    seen = {}
    done = job[0](
        checkpoint=folder / "run.npz", log=folder / "log.jsonl",
        callback=lambda step, fields, terms: seen.update({step: fields}),
    )  # fmt: skip
    return done, folder, seen


def interrupt_at(step):
    """A callback that sends what Ctrl-C sends."""

    def callback(k, fields, terms):
        if k == step:
            os.kill(os.getpid(), signal.SIGINT)

    return callback


def test_a_run_with_a_guide_goes_on_with_the_one_it_had(job, tmp_path):
    """Stopped at step 4 with the guide of step 3, on which its searches still run."""
    call, _, config = job
    search = replace(config.search, cached=False, guide_every=3, max_steps=8)
    config = replace(config, steps=8, search=search)
    done = call(config=config)
    assert len(done.history.validated) > 1
    file = tmp_path / "run.npz"
    with pytest.raises(Interrupted):
        call(config=config, checkpoint=file, callback=interrupt_at(4))
    resumed = call(config=config, checkpoint=file, resume=True)
    assert same(done.avatar.fields, resumed.avatar.fields)
    assert resumed.history.validation == done.history.validation


def test_a_run_that_lands_on_a_plateau_goes_on_landing(job, tmp_path):
    """Stopped on the way down, which is from step 8 to step 10."""
    call, _, config = job
    validation = replace(config.validation, gain=1.0, patience=2)
    config = replace(config, report_every=1, validation=validation)
    done = call(config=config)
    assert (done.history.landing, done.history.steps_done) == (8, 10)
    file = tmp_path / "run.npz"
    with pytest.raises(Interrupted, match="step 9 of 10"):
        call(config=config, checkpoint=file, callback=interrupt_at(8))
    resumed = call(config=config, checkpoint=file, resume=True)
    assert same(done.avatar.fields, resumed.avatar.fields)
    assert resumed.history.stopped == done.history.stopped == "plateau"
    # More steps are another plan: with them there is no plateau yet.
    more = call(config=replace(config, steps=40), checkpoint=file, resume=True)
    assert more.history.steps_done > 20


def test_a_stopped_run_goes_on_bit_for_bit(job, whole, tmp_path, monkeypatch):
    call, _, _ = job
    whole, folder, _ = whole
    path, log = tmp_path / "run.npz", tmp_path / "log.jsonl"
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(Interrupted, match=r"step 7 of 12.*run\.npz.*resume=True") as stopped:
        call(checkpoint=path, log=log, callback=interrupt_at(6))
    assert signal.getsignal(signal.SIGINT) is handler
    assert stopped.value.signal == signal.SIGINT

    def not_again(*_, **__):
        raise AssertionError("points and roots are in the checkpoint")

    with monkeypatch.context() as patch:
        patch.setattr(loop, "label_frames", not_again)
        resumed = call(checkpoint=path, log=log, resume=True)
    assert same(resumed.avatar.fields, whole.avatar.fields)
    for name in ("validated", "validation", "best_step", "steps_done", "stopped"):
        assert getattr(resumed.history, name) == getattr(whole.history, name), name

    def losses(file):
        return {r["step"]: r["loss"] for r in read_log(file) if "loss" in r}

    assert losses(folder / "log.jsonl").items() <= losses(log).items()
    # A finished run that is taken up again is finished.
    again = call(checkpoint=path, resume=True)
    assert same(again.avatar.fields, whole.avatar.fields)


def test_a_killed_run_goes_on_from_its_last_checkpoint(job, whole, tmp_path):
    call, _, _ = job
    path = tmp_path / "run.npz"

    def die(k, fields, terms):
        if k == 6:
            raise MemoryError  # not one of the ways a run ends in order

    with pytest.raises(MemoryError):
        call(checkpoint=path, callback=die)
    assert load_arrays(path)[1]["step"] == 4
    assert same(call(checkpoint=path, resume=True).avatar.fields, whole[0].avatar.fields)


def test_nothing_to_go_on_from_is_said(job, tmp_path):
    call, _, config = job
    short = replace(config, minutes=1e-6)
    with pytest.warns(TrainingNotice, match=r"no checkpoint at .*run\.npz: .* step 0"):
        done = call(config=short, checkpoint=tmp_path / "run.npz", resume=True)
    assert "begins at step 0" in done.history.notices[0]
    assert (done.history.stopped, done.history.steps_done) == ("minutes", 0)
    with pytest.raises(ValueError, match="needs checkpoint"):
        call(config=short, resume=True)


@pytest.fixture
def saved(whole, tmp_path):
    """A checkpoint of the job, to be damaged."""
    return shutil.copy(whole[1] / "run.npz", tmp_path / "run.npz")


def test_other_runs_are_refused(job, saved):
    call, frames, config = job
    with pytest.raises(ValueError, match=r"run\.npz.*losses\.softness \(0\.004, now 0\.01\)"):
        call(config=replace(config, losses=replace(config.losses, softness=0.01)),
             checkpoint=saved, resume=True)  # fmt: skip
    moved = replace(frames.params, pose=frames.params.pose.at[0, 3].add(0.1))
    others = xa.Frames(moved, lambda i: (frames[i].vertices, frames[i].faces))
    with pytest.raises(ValueError, match="a run on other frames"):
        call(frames=others, checkpoint=saved, resume=True)
    longer = call(config=replace(config, steps=14), checkpoint=saved, resume=True)
    assert longer.history.steps_done == 14


def test_damage_and_other_files_are_named(job, saved, tmp_path):
    call, _, _ = job
    arrays, header = load_arrays(saved)
    for change, message in (
        ({"kind": "avatar"}, "not a checkpoint, but avatar"),
        ({"format": 99}, "format 99; this version"),
    ):
        save_arrays(tmp_path / "other.npz", arrays, {**header, **change})
        with pytest.raises(ValueError, match=message):
            call(checkpoint=tmp_path / "other.npz", resume=True)
    saved.write_bytes(saved.read_bytes()[:-5000])
    with pytest.raises(ValueError, match=r"run\.npz"):
        call(checkpoint=saved, resume=True)


def test_other_versions_are_said(job, saved):
    call, _, _ = job
    arrays, header = load_arrays(saved)
    header["versions"]["jax"] = "0.0.1"
    save_arrays(saved, arrays, header)
    with pytest.warns(TrainingNotice, match=r"jax 0\.0\.1 \(now .*may\s+differ"):
        call(checkpoint=saved, resume=True)


def test_a_checkpoint_holds_plain_arrays_and_json(saved):
    arrays, header = load_arrays(saved)
    assert not any(value.dtype.hasobject for value in arrays.values())
    assert header["run"]["config"]["seed"] == 0
    assert {"xavatar_jax", "jax", "numpy", "device"} <= set(header["versions"])
    assert any(name.startswith("state:optimisers") for name in arrays)


def test_without_a_checkpoint_an_interrupt_says_so(job):
    call, _, _ = job
    with pytest.raises(Interrupted, match="nothing was saved") as stopped:
        call(callback=interrupt_at(6))
    assert isinstance(stopped.value, KeyboardInterrupt)
    assert stopped.value.fitted.history.stopped == "interrupt"


def spoilt_at(step, seed):
    """The geometry objective with an occupancy that is not a number in one step."""
    _, key = jax.random.split(jax.random.fold_in(jax.random.key(seed), step))
    wanted = jax.random.key_data(key)
    objective = step_module.geometry_objective

    def spoilt(fields, batch, anchors, config, key):
        total, terms = objective(fields, batch, anchors, config, key)
        bad = jnp.where((jax.random.key_data(key) == wanted).all(), jnp.nan, 0.0)
        return total + bad, {**terms, "occupancy": terms["occupancy"] + bad}

    return spoilt


@pytest.mark.parametrize("skinning_every", [4, 7])
def test_a_loss_that_is_not_finite_keeps_the_last_good_state(
    job, tmp_path, other_objective, skinning_every
):
    """In the seventh step: the state kept is that after six, whatever kind the eighth is of."""
    call, _, config = job
    config = replace(config, skinning_every=skinning_every)
    other_objective(spoilt_at(6, config.seed))
    path, seen = tmp_path / "run.npz", {}
    with pytest.raises(TrainingError, match=r"occupancy term is nan at step 7.*run\.npz") as error:
        call(
            config=config,
            checkpoint=path,
            callback=lambda step, fields, terms: seen.update({step: fields}),
        )
    assert error.value.step == 7
    assert error.value.term == "occupancy"
    assert error.value.fitted.history.steps_done == 6
    assert error.value.fitted.history.stopped == "not finite"
    arrays, header = load_arrays(path)
    assert header["step"] == 6
    good = flatten_named(seen[6])
    kept = {n.removeprefix("state:learned."): v for n, v in arrays.items() if ":learned." in n}
    assert len(kept) > 4
    for name, value in kept.items():
        np.testing.assert_array_equal(value, good[name], err_msg=name)


def test_an_infinite_gradient_of_a_finite_loss_is_named(case, other_objective):
    body, _, config, fields, pool = case
    objective = step_module.geometry_objective

    def steep(fields, *rest):
        total, terms = objective(fields, *rest)
        # The root of zero: its value is zero, its slope is infinite.
        return total + jnp.sqrt(0.0 * fields.geometry.biases[0].sum()), terms

    other_objective(steep)
    with pytest.raises(TrainingError, match="gradient term is nan at step 1"):
        train_pool(body, fields, pool, np.zeros(10), config, verbose=False)


def test_the_log_is_json_lines(whole):
    lines = (whole[1] / "log.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    assert records[0]["event"] == "start"
    assert records[0]["config"]["steps"] == 12
    assert records[-1]["event"] == "stop"
    assert records[-1]["reason"] == "steps"
    step = records[3]
    assert step["step"] == 6
    assert {"loss", "occupancy", "gradient", "skinning_loss", "validation", "seconds"} <= set(step)


def test_a_log_cut_off_is_read_and_a_damaged_one_is_named(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 25}\n{"step": 50}\n{"ste')
    assert [r["step"] for r in read_log(path)] == [25, 50]
    path.write_text('{"step": 25}\nnot json\n{"step": 50}\n')
    with pytest.raises(ValueError, match=r"log\.jsonl, line 2: not JSON"):
        read_log(path)
