"""Which frames are read when, figures by distance of pose, and how the example ends."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax import methods, report
from xavatar_jax.avatar import Evaluation
from xavatar_jax.cli import fit as command
from xavatar_jax.learning import Interrupted
from xavatar_jax.metrics import MeshMetrics, RegionValues

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "fit_grab.py"


def read_by(frames: xa.Frames, events: list[str]) -> xa.Frames:
    """The same frames, with a note of each that is read."""

    def load(i: int):
        events.append(f"read {i}")
        return frames[i].vertices, frames[i].faces

    return xa.Frames(frames.params, load, part_labels=frames[0].part_labels, body=frames.body)


def test_held_out_frames_are_read_after_training_alone(run, tmp_path, monkeypatch):
    """The command from end to end: no held-out mesh is read before `fit` has ended."""
    events: list[str] = []
    test = read_by(run.test, events)
    capture = SimpleNamespace(body=run.body, name="case", train=run.train, test=test, notices=())
    short = replace(run.config, steps=4, report_every=2)
    evaluate = xa.evaluate

    def noted_fit(frames, config, **options):
        events.append("fit begins")
        # From the model of all these tests, for whose grids there are programs.
        done = xa.fit(frames, config, model=run.fit.avatar.model, **options)
        events.append("fit ends")
        return done

    def quick_evaluate(avatar, frames, **options):
        # Of the avatar of all these tests, whose surface is there already.
        return evaluate(run.fit.avatar, frames, **{**options, "num_frames": 1})

    method = methods.Method(noted_fit, methods.PRESETS)
    monkeypatch.setattr(methods, "METHODS", {"xavatar": method})
    monkeypatch.setattr(xa, "evaluate", quick_evaluate)
    monkeypatch.setattr(command, "load", lambda options: capture)
    monkeypatch.setattr(command, "configure", lambda options: short)
    monkeypatch.setattr(command, "write_meshes", lambda *_: [])
    monkeypatch.setattr(report, "preview", lambda *_: np.zeros((4, 4, 3), np.uint8))
    monkeypatch.setattr(report, "animation", lambda *_: [np.zeros((4, 4, 3), np.uint8)] * 2)
    command.run(command.Options(out=tmp_path, quiet=True))

    assert events[:2] == ["fit begins", "fit ends"]
    assert any(event.startswith("read") for event in events[2:])
    record = json.loads((tmp_path / "metrics.json").read_text())
    assert record["training"]["steps_done"] == 4
    assert record["training"]["frames"] == 8
    assert record["by_pose_distance"]["near"]["frames"] == 1
    assert record["per_frame"][0]["pose_distance_deg"] > 1
    for name in ("checkpoint.npz", "log.jsonl", "losses.png"):
        assert (tmp_path / name).stat().st_size > 100


def metrics(value: float) -> MeshMetrics:
    return MeshMetrics(*(RegionValues(value, value, value) for _ in range(7)))


def test_figures_by_distance_of_pose_are_means_of_thirds():
    distances = (9.0, 1.0, 5.0, 2.0, 7.0, 6.0)
    records = tuple(metrics(10 * d) for d in distances)
    evaluation = Evaluation(metrics(0), records, tuple("abcdef"), distances)
    groups = evaluation.to_json()["by_pose_distance"]
    assert {name: group["pose_distance_deg"] for name, group in groups.items()} == {
        "near": [1, 2], "middle": [5, 6], "far": [7, 9],
    }  # fmt: skip
    assert [group["cd_mm"]["hands"] for group in groups.values()] == [15, 55, 80]
    assert [group["frames"] for group in groups.values()] == [2, 2, 2]
    json.dumps(evaluation.to_json(), allow_nan=False)


def test_fewer_than_three_frames_make_fewer_groups():
    two = Evaluation(metrics(0), (metrics(1), metrics(2)), ("a", "b"), (3.0, 1.0))
    assert {name: g.mean.cd_mm.all for name, g in two.by_pose_distance().items()} == {
        "near": 2, "middle": 1,
    }  # fmt: skip
    without = Evaluation(metrics(0), (metrics(1),), ("a",))
    assert without.by_pose_distance() == {}
    assert "by_pose_distance" not in without.to_json()


@pytest.mark.parametrize(("number", "code"), [(2, 130), (15, 143)])
def test_the_example_says_how_to_go_on(run, tmp_path, monkeypatch, capsys, number, code):
    def stopped(*_, checkpoint, **__):
        raise Interrupted(f"kept in {checkpoint}.", step=3, signal=number, fitted=None)

    capture = SimpleNamespace(body=run.body, name="case", train=run.train, test=run.test)
    monkeypatch.setattr(xa, "synthetic_body", lambda *_: run.body)
    monkeypatch.setattr(xa, "synthetic_capture", lambda *_, **__: capture)
    method = methods.Method(stopped, methods.PRESETS)
    monkeypatch.setattr(methods, "METHODS", {"xavatar": method})
    monkeypatch.setattr(sys, "argv", ["fit_grab.py", "--out", str(tmp_path), "--quiet"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert ended.value.code == code
    said = capsys.readouterr().err
    assert "checkpoint.npz" in said
    assert "--resume" in said
