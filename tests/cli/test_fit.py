"""`xavatar fit` and `xavatar evaluate`: options, config, what is asked of the library."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax import methods
from xavatar_jax.avatar import Avatar, BodyOnlyAvatar, body_only
from xavatar_jax.cli import fit
from xavatar_jax.fields import build_model
from xavatar_jax.learning import TrainingError
from xavatar_jax.meshing import EmptyLevelSetError


def config_of(*words: str) -> xa.FitConfig:
    return fit.configure(fit.parse(words, "xavatar fit"))


def test_presets_and_short_options():
    assert config_of() == xa.quick()
    assert config_of("--preset", "paper") == xa.paper()
    expected = replace(xa.quick(), steps=5, seed=3, minutes=0.5, train_frames=0, prefit_steps=7)
    given = "--steps 5 --seed 3 --minutes 0.5 --train-frames 0 --prefit-steps 7"
    assert config_of(*given.split()) == expected


def test_every_other_entry_is_an_option():
    given = (
        "--config.points-per-step 256 --seed 4 --config.losses.surface 50 --preset paper "
        "--config.points.sigma 0.001 0.02 --config.optimiser.learning-rate=3e-3 "
        "--config.search.cached --config.geometry.mlp.width 64 --steps 9"
    )
    base = xa.paper()
    expected = replace(
        base,
        seed=4,
        steps=9,
        points_per_step=256,
        losses=replace(base.losses, surface=50.0),
        points=replace(base.points, sigma=(0.001, 0.02)),
        optimiser=replace(base.optimiser, learning_rate=3e-3),
        search=replace(base.search, cached=True),
        geometry=replace(base.geometry, mlp=replace(base.geometry.mlp, width=64)),
    )
    assert config_of(*given.split()) == expected


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--config.steps", "3"], "use the option --steps"),
        (["--config.train-frames=3"], "use the option --train-frames"),
        (["--config.losses.surfac", "3"], "Unrecognized"),
        (["--config.losses.surface", "much"], "surface"),
        (["--eval-frames", "0"], 'a number above zero or "all"'),
        (["--preset", "slow"], "preset"),
        (["--method", "pifu"], "method"),
        (["--method", "scanimate", "--steps", "5"], "--steps is not an option of scanimate"),
        (
            ["--method", "scanimate", "--prefit-steps", "5"],
            "--prefit-steps is not an option of scanimate",
        ),
        (["--data", "nowhere"], "nowhere"),
        (["--body", "nowhere.npz"], "no body model found"),
    ],
)
def test_wrong_options(call, tmp_path, monkeypatch, bundled_body, words, complaint):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(xa, "synthetic_body", lambda *_: bundled_body)
    code, _, error = call("fit", "--quiet", *words)
    assert code == 2
    assert complaint in error


def test_models_of_the_environment_are_for_ones_own_data(call, tmp_path, monkeypatch):
    monkeypatch.setenv("SMPLX_MODEL_DIR", str(tmp_path / "models"))
    (tmp_path / "data").mkdir()
    code, _, error = call("fit", "--quiet", "--data", tmp_path / "data")
    assert code == 2
    assert "no body model found" in error
    assert str(tmp_path / "models") in error


def test_help_of_the_config_is_apart(call):
    code, short, _ = call("fit", "--help")
    assert code == 0
    assert "--config.help" in short
    assert "--config.losses" not in short.replace("as --config.losses.surface 50", "")
    code, full, _ = call("fit", "--preset", "paper", "--config.help")
    assert code == 0
    assert "--config.points-per-step" in full
    assert "(default: 6000)" in full
    assert "--config.steps" not in full


@pytest.mark.parametrize("method", ["snarf", "scanimate"])
def test_other_methods_have_their_own_configs(call, method):
    given = ["--method", method, "--minutes", "2", "--seed", "3", "--config.clip", "0.5"]
    if method == "snarf":
        given = [*given[:-2], "--steps", "7"]
    expected = methods.METHODS[method].presets["quick"]()
    change = {"steps": 7} if method == "snarf" else {"clip": 0.5}
    assert config_of(*given) == replace(expected, minutes=2, seed=3, **change)
    code, full, _ = call("fit", "--method", method, "--config.help")
    assert code == 0
    assert ("--config.shape.steps" in full) == (method == "scanimate")


def test_what_it_asks_of_the_library(call, tmp_path, monkeypatch, bundled_body):
    asked = {}
    capture = SimpleNamespace(body=bundled_body, name="case", train=[1], test=[2])

    def stop(frames, config, **options):
        asked.update(options, frames=frames, config=config)
        raise TrainingError("the occupancy term is nan at step 3", step=3)

    monkeypatch.setattr(xa, "synthetic_body", lambda *_: bundled_body)
    monkeypatch.setattr(xa, "synthetic_capture", lambda *_, **__: capture)
    monkeypatch.setattr(methods, "METHODS", {"xavatar": methods.Method(stop, methods.PRESETS)})
    out = tmp_path / "out"
    code, said, error = call("fit", "--out", out, "--resume", "--config.losses.bone", 2)
    assert (code, error) == (1, "error: the occupancy term is nan at step 3\n")
    assert "case: 1 training and 1 held-out frames" in said
    assert asked["frames"] == [1]
    assert asked["config"].losses.bone == 2
    assert asked["resume"]
    assert asked["checkpoint"] == out / "checkpoint.npz"
    assert asked["log"] == out / "log.jsonl"

    file = tmp_path / "file"
    file.write_text("")
    code, _, error = call("fit", "--out", file / "out")
    assert code == 2
    assert "is not a folder" in error


def test_a_field_without_a_surface_ends_it_with_advice(call, tmp_path, monkeypatch, bundled_body):
    class Result(tuple):
        frames = before = None

    def evaluate(*_, **__):
        raise EmptyLevelSetError("Everything is inside.")

    avatar = SimpleNamespace(save=lambda path: None)
    done = Result((avatar, SimpleNamespace(steps_done=3)))
    capture = SimpleNamespace(body=bundled_body, name="case", train=[1], test=[2])
    monkeypatch.setattr(xa, "synthetic_body", lambda *_: bundled_body)
    monkeypatch.setattr(xa, "synthetic_capture", lambda *_, **__: capture)
    method = methods.Method(lambda *_, **__: done, methods.PRESETS)
    monkeypatch.setattr(methods, "METHODS", {"xavatar": method})
    monkeypatch.setattr(xa, "evaluate", evaluate)
    code, _, error = call("fit", "--out", tmp_path, "--quiet")
    assert code == 1
    assert "after 3 steps" in error
    assert "Everything is inside. The avatar and its checkpoint are in" in error
    assert "--prefit-steps" in error


@pytest.mark.usefixtures("coarse")
def test_evaluate_prints_and_writes_the_same_figures(call, avatar_file, tmp_path):
    out = tmp_path / "figures" / "metrics.json"
    code, said, error = call("evaluate", avatar_file, "--eval-frames", 1, "--out", out)
    assert code == 0
    # On a slow machine, lines of progress.
    assert all(line.startswith("evaluation: ") for line in error.splitlines())
    record = json.loads(out.read_text())
    assert record["frames"] == 1
    assert record["preset"] == "paper"
    # A ball of half a metre is no person: centimetres away.
    assert 20 < record["cd_mm"]["all"] < 1000
    row = next(line for line in said.splitlines() if line.startswith("Chamfer"))
    assert f"{record['cd_mm']['all']:.2f}" in row
    assert str(out) in said


@pytest.mark.usefixtures("coarse")
def test_evaluate_takes_baselines_without_fingers(call, bundled_body, avatar_file, tmp_path):
    cut = body_only(bundled_body)
    spec = xa.load_avatar(avatar_file).spec
    model = build_model(spec, cut, key=jax.random.key(0))
    own = Avatar(cut, np.zeros(10), model, spec, method="snarf", options={"seed": 4})
    BodyOnlyAvatar(bundled_body, own).save(tmp_path / "snarf.npz")
    out = tmp_path / "metrics.json"
    code, _, error = call(
        *("evaluate", tmp_path / "snarf.npz", "--eval-frames", 1, "--out", out, "--quiet")
    )
    assert (code, error) == (0, "")
    record = json.loads(out.read_text())
    assert (record["frames"], record["seed"]) == (1, 4)


def test_evaluate_splits_as_the_avatar_was_learned(call, avatar_file, tmp_path, monkeypatch):
    asked = []

    def stop(data, body, **options):
        asked.append((options["split_seed"], options["flat_hand_mean"]))
        raise ValueError("enough")

    body = xa.load_avatar(avatar_file).body
    avatar = xa.load_avatar(avatar_file, body=body)
    replace(avatar, options={"seed": 5}).save(tmp_path / "five.npz")
    monkeypatch.setattr(xa, "load_data", stop)
    for more in ((), ("--seed", 2, "--flat-hand-mean", "False")):
        call("evaluate", tmp_path / "five.npz", "--data", tmp_path, *more)
    assert asked == [(5, None), (2, False)]


def test_evaluate_looks_at_its_input_first(call, avatar_file, motion_file, tmp_path):
    code, _, error = call("evaluate", motion_file, "--out", tmp_path / "a.json")
    assert code == 2
    assert "so xavatar_jax did not write it" in error
    code, _, error = call("evaluate", avatar_file, "--data", tmp_path / "no")
    assert code == 2
    assert "No data folder" in error
    code, _, error = call("evaluate", avatar_file, "--out", tmp_path)
    assert code == 2
    assert "this is a folder; give a file name" in error
    assert list(tmp_path.iterdir()) == []
