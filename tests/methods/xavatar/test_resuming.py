"""`fit` that was stopped has the numbers of one that was not, and refuses other runs' files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import run_as_user

import xavatar_jax as xa
from xavatar_jax.files import load_arrays
from xavatar_jax.learning import TrainingNotice

# Cached roots that are polished and redrawn, and searches in the step on a guide.
STOPPED = """
import json, sys
from dataclasses import replace
from pathlib import Path
from small_runs import fresh_model, interrupt_at, posed_frames, same, tiny
from toy_smplx import write_toy_body
import xavatar_jax as xa
from xavatar_jax.learning import Interrupted

folder = Path(sys.argv[1])
body = xa.load_body(write_toy_body(folder / "SMPLX_NEUTRAL.npz"), num_betas=10, num_expression=10)
frames, quick = posed_frames(body, 12), tiny(xa.quick())
validation = replace(quick.validation, every=3, points=64)
cached = replace(
    quick, steps=8, train_frames=2, report_every=2, polish_every=3, redraw_every=3,
    redraw_frames=1, checkpoint_every=3, validation=validation,
)
search = replace(quick.search, cached=False, guide_every=3)
guided = replace(cached, search=search, redraw_every=0)
found = {}
for name, config in (("cached", cached), ("guided", guided)):
    model = fresh_model(body, config)
    def call(**options):
        return xa.fit(frames, config, body=body, model=model, verbose=False, **options)
    path = folder / f"{name}.npz"
    whole = call()
    try:
        call(checkpoint=path, callback=interrupt_at(4))
    except Interrupted as stopped:
        at = stopped.step
        ended = isinstance(stopped.fitted, xa.Fit)
    resumed = call(checkpoint=path, resume=True)
    again = call(checkpoint=path, resume=True)
    found[name] = {
        "at": at, "fit": ended,
        "same": [same(r.avatar.model, whole.avatar.model) for r in (resumed, again)],
        "validation": [resumed.history.validation == whole.history.validation,
                       len(whole.history.validation)],
        "moved": not same(whole.avatar.model, model),
        "seconds": sorted(resumed.history.seconds),
    }
print("RESULT", json.dumps(found))
"""


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    return run_as_user(STOPPED, tmp_path_factory.mktemp("run"), paths=(Path(__file__).parent,))


@pytest.mark.parametrize(
    ("name", "work"), [("cached", {"polish", "redraw"}), ("guided", {"guide"})]
)
def test_a_stopped_run_is_resumed_bit_for_bit(stopped, name, work):
    found = stopped[name]
    assert found["at"] == 5
    assert found["fit"]
    assert found["moved"]
    assert found["same"] == [True, True]
    assert found["validation"] == [True, 3]
    assert work <= set(found["seconds"])


@pytest.fixture(scope="module")
def finished(case, tmp_path_factory):
    path = tmp_path_factory.mktemp("finished") / "run.npz"
    config = replace(case.config, steps=2)
    return case.fit(config=config, checkpoint=path), path, config


@pytest.fixture
def saved(finished, tmp_path):
    return Path(shutil.copy(finished[1], tmp_path / "run.npz"))


def test_other_options_parameters_and_meshes_are_refused(case, finished, saved):
    config = finished[2]

    def resume(**changes):
        return case.fit(**{"config": config, "checkpoint": saved, "resume": True, **changes})

    softer = replace(config, losses=replace(config.losses, softness=0.01))
    with pytest.raises(ValueError, match=r"run\.npz.*losses\.softness \(0\.004, now 0\.01\)"):
        resume(config=softer)
    frames = case.frames
    moved = replace(frames.params, pose=frames.params.pose.at[0, 3].add(0.1))
    others = xa.Frames(moved, lambda i: (frames[i].vertices, frames[i].faces))
    with pytest.raises(ValueError, match="a run on other frames"):
        resume(frames=others)
    # The same parameters, and a vertex of one mesh a millimetre away.
    nudge = np.zeros_like(np.asarray(frames[1].vertices))
    nudge[7, 0] = 0.001
    others = xa.Frames(
        frames.params, lambda i: (frames[i].vertices + nudge * (i == 1), frames[i].faces)
    )
    with pytest.raises(ValueError, match="a run on other frames"):
        resume(frames=others)
    assert resume(config=replace(config, steps=3)).history.steps_done == 3


def test_a_run_is_continued_with_more_minutes_and_steps(case, finished, saved):
    """Another budget is another plan, of which the first one's is forgotten."""
    config = replace(finished[2], steps=4, minutes=60.0)
    done = case.fit(config=config, checkpoint=saved, resume=True)
    assert (done.history.steps_done, done.history.stopped) == (4, "steps")
    assert done.history.planned in (0, 4)


def test_nothing_to_continue_from_is_said(case, tmp_path):
    short = replace(case.config, minutes=1e-6)
    with pytest.warns(TrainingNotice, match=r"no checkpoint at .*run\.npz: .* step 0"):
        done = case.fit(config=short, checkpoint=tmp_path / "run.npz", resume=True)
    assert "starts at step 0" in done.history.notices[0]
    assert (done.history.stopped, done.history.steps_done) == ("minutes", 0)
    with pytest.raises(ValueError, match="needs checkpoint"):
        case.fit(config=short, resume=True)


def test_a_checkpoint_holds_points_roots_and_options(finished):
    arrays, header = load_arrays(finished[1])
    assert header["run"]["options"]["seed"] == 0
    assert {"data:samples.x_d", "data:roots.first", "data:roots.valid"} <= set(arrays)
    assert not any(name.startswith("data:transforms") for name in arrays)
