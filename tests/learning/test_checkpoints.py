"""Checkpoints: a run that was stopped has the numbers of one that was not; others are refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import run_as_user
from toy_problem import identity, line, points, run, stage

from xavatar_jax.files import load_arrays, save_arrays
from xavatar_jax.learning import (
    ONE_DEVICE,
    Identity,
    Keeper,
    Schedule,
    TrainingNotice,
    load_checkpoint,
    read_log,
    train,
)

# Every way that a run can end early, and the run that is resumed from its file.
STOPPED = """
import json, sys
from pathlib import Path
from toy_problem import HeldError, Spoil, identity, interrupt_at, run, same
from xavatar_jax.learning import (
    ONE_DEVICE, Interrupted, TrainingError, Validation, load_checkpoint
)

folder = Path(sys.argv[1])
seen = {}
whole = run(folder / "whole.npz", log=folder / "whole.jsonl",
            callback=lambda k, model, terms: seen.update({k: model}))
found = {}

def compare(name, resumed, whole=whole):
    names = ("validated", "validation", "best_step", "steps_done", "stopped", "landing")
    found[name] = [same(resumed.model, whole.model)] + [
        n for n in names if getattr(resumed.history, n) != getattr(whole.history, n)
    ]

path, log = folder / "interrupted.npz", folder / "interrupted.jsonl"
try:
    run(path, log=log, callback=interrupt_at(6))
except Interrupted as stopped:
    found["message"], found["signal"] = str(stopped), int(stopped.signal)
compare("interrupted", run(path, resume=True, log=log))
compare("finished", run(path, resume=True, log=log))

def die(k, model, terms):
    if k == 6:
        raise MemoryError  # not one of the ways a run ends in order

path = folder / "killed.npz"
try:
    run(path, callback=die)
except MemoryError:
    found["killed_at"] = load_checkpoint(path, identity(), ONE_DEVICE).step
compare("killed", run(path, resume=True))

# Step 7 is not finite. Points are not kept, so that the resumed run has good ones.
path, rest = folder / "spoilt.npz", {"kept": False, "upkeep": (), "validation": None}
try:
    run(path, kept=False, upkeep=(Spoil(6),), validation=None)
except TrainingError as error:
    found["spoilt_at"] = [error.step, error.term]
compare("spoilt", run(path, resume=True, **rest), run(**rest))

# On the way down, which is from step 8 to step 10.
land = {"validation": Validation(HeldError(10), every=3, gain=1.0, patience=2)}
land["report_every"] = 1
path, landed = folder / "landing.npz", run(**land)
try:
    run(path, callback=interrupt_at(8), **land)
except Interrupted as stopped:
    found["landing_message"] = str(stopped)
compare("landing", run(path, resume=True, **land), landed)
found["landing_steps"] = [landed.history.landing, landed.history.steps_done]
print("RESULT", json.dumps(found))
"""


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stopped")
    return run_as_user(STOPPED, folder, paths=(Path(__file__).parent,)), folder


def test_an_interrupted_run_is_resumed_bit_for_bit(stopped):
    found, folder = stopped
    assert "step 7 of 12" in found["message"]
    assert "interrupted.npz" in found["message"]
    assert "resume=True" in found["message"]
    assert found["signal"] == 2
    assert found["interrupted"] == found["finished"] == [True]

    def losses(name):
        return {r["step"]: r["loss"] for r in read_log(folder / name) if "loss" in r}

    assert losses("whole.jsonl").items() <= losses("interrupted.jsonl").items()


def test_a_killed_run_is_resumed_from_its_last_checkpoint(stopped):
    found, _ = stopped
    assert found["killed_at"] == 4
    assert found["killed"] == [True]


def test_a_run_that_was_not_finite_is_resumed_from_the_last_good_step(stopped):
    found, _ = stopped
    assert found["spoilt_at"] == [7, "error"]
    assert found["spoilt"] == [True]


def test_a_run_that_lands_on_a_plateau_goes_on_landing(stopped):
    found, _ = stopped
    assert found["landing_steps"] == [8, 10]
    assert "step 9 of 10" in found["landing_message"]
    assert found["landing"] == [True]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("finished") / "run.npz"
    run(path)
    return path


@pytest.fixture
def saved(finished, tmp_path):
    """A checkpoint, to be damaged."""
    return Path(shutil.copy(finished, tmp_path / "run.npz"))


def load(path, identity=identity(), notices=None):  # noqa: B008
    return load_checkpoint(path, identity, ONE_DEVICE, notices)


def test_other_runs_are_refused(saved):
    with pytest.raises(ValueError, match=r"run\.npz: the checkpoint of a run on other points"):
        load(saved, identity(points="4a"))
    with pytest.raises(ValueError, match="a run on other weather"):
        load(saved, identity(weather="wet"))
    own = identity()
    faster = replace(own, options={**own.options, "rates": {"slope": 0.1, "offset": 0.05}})
    with pytest.raises(ValueError, match=r"other options: rates\.slope \(0\.05, now 0\.1\).*steps"):
        load(saved, faster)
    assert load(saved, replace(faster, free=("steps", "rates.slope"))).step == 12


def test_what_is_free_may_change(saved):
    longer = replace(identity(), options={**identity().options, "steps": 14})
    assert load(saved, longer).options["steps"] == 12
    assert run(saved, resume=True, steps=14).history.steps_done == 14


def test_a_list_of_options_is_the_tuple_that_it_was(tmp_path):
    own = Identity({}, {"sigma": (0.1, 0.2)})
    keeper = Keeper(tmp_path / "run.npz", own)
    train(line(), points(), [stage()], Schedule(1), keeper=keeper, verbose=False)
    assert load(tmp_path / "run.npz", own).step == 1


def test_damage_and_other_files_are_named(saved, tmp_path):
    arrays, header = load_arrays(saved)
    other = tmp_path / "other.npz"
    for change, message in (
        ({"kind": "avatar"}, "expected a checkpoint, found avatar"),
        ({"format": 99}, "format 99"),
        ({"format": 1}, "an older version"),
        ({"format": None}, "not a number"),
    ):
        save_arrays(other, arrays, {**header, **change})
        with pytest.raises(ValueError, match=message) as error:
            load(other)
        assert "other.npz" in str(error.value)
    saved.write_bytes(saved.read_bytes()[:-500])
    with pytest.raises(ValueError, match=r"run\.npz"):
        load(saved)
    with pytest.raises(FileNotFoundError, match="no checkpoint at"):
        load(tmp_path / "none.npz")


def test_other_versions_are_said(saved):
    arrays, header = load_arrays(saved)
    header["versions"]["jax"] = "0.0.1"
    save_arrays(saved, arrays, header)
    notices = []
    with pytest.warns(TrainingNotice, match=r"jax 0\.0\.1 \(now .*may differ"):
        load(saved, notices=notices)
    assert len(notices) == 1


def test_a_checkpoint_holds_plain_arrays_and_json(saved):
    arrays, header = load_arrays(saved)
    assert not any(value.dtype.hasobject for value in arrays.values())
    assert header["run"]["options"]["rates"]["slope"] == 0.05
    assert {"xavatar_jax", "jax", "numpy", "device"} <= set(header["versions"])
    assert any(name.startswith("state:optimisers") for name in arrays)
    checkpoint = load(saved)
    assert set(checkpoint.part("data")) == {"x", "y"}
    assert checkpoint.history().validated == [3, 6, 9, 12]
    assert checkpoint.header["best"]["step"] in checkpoint.history().validated
