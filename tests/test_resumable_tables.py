"""Tables of benchmarks: rows are kept as they end, and a second call goes on."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.frames import frames_from_params

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def resumable():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        import resumable  # pyright: ignore[reportMissingImports]

        patch.setattr(resumable.jax, "clear_caches", lambda: None)
        yield resumable
        for name in ("resumable", "measuring"):
            sys.modules.pop(name, None)


@pytest.fixture
def table(resumable, tmp_path):
    """A table of two methods and three seeds, the runs that were made, and what fails."""
    jobs = resumable.every(name=("a", "b"), seed=range(3))
    made, bad = [], set()

    def run(name, seed):
        if (name, seed) in bad:
            raise ArithmeticError(f"{name} {seed}")
        made.append((name, seed))
        return {"cd_mm": float(ord(name) + seed**2), "said": "yes", "nothing": float("nan")}

    def fill(jobs=jobs, known=(), **settings):
        return resumable.fill(
            jobs, run, question="?", settings={"minutes": 3.0, **settings},
            file=tmp_path / "table.json", known=known,
        )  # fmt: skip

    return fill, made, bad, tmp_path / "table.json"


def test_a_table_goes_on_where_it_stopped(table, capsys):
    fill, made, bad, file = table
    bad.add(("a", 2))
    with pytest.raises(SystemExit, match="1 of 6 runs failed: a, seed 2"):
        fill()
    assert "ArithmeticError: a 2" in capsys.readouterr().err
    assert [(r["name"], r["seed"]) for r in json.loads(file.read_text())["rows"]] == made
    assert len(made) == 5
    bad.clear()
    made.clear()
    header, rows = fill()
    assert made == [("a", 2)]
    assert header["minutes"] == 3.0
    assert len(rows) == 6
    assert rows[0]["nothing"] is None
    assert all(row["row_s"] >= 0 for row in rows)
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["name", "seeds", "cd_mm", "row_s"] in printed
    assert ["a", "3", "98"] in [words[:3] for words in printed]  # 97, 98, 101


def test_runs_known_from_elsewhere_are_not_made_again(table):
    fill, made, _, file = table
    known = [{"name": "b", "seed": 1, "cd_mm": 5.0}, {"name": "c", "seed": 0, "cd_mm": 6.0}]
    fill(jobs=[{"name": "b", "seed": 1}], known=known)
    assert not made
    assert json.loads(file.read_text())["rows"] == known
    for _ in range(2):
        _, rows = fill(known=known)
        assert len(made) == 5
        assert ("b", 1) not in made
        assert len(rows) == 6
        assert [r["cd_mm"] for r in rows if (r["name"], r["seed"]) == ("b", 1)] == [5.0]
        assert len(json.loads(file.read_text())["rows"]) == 7


def test_medians_are_over_seeds(resumable):
    rows = [
        {"name": "a", "seed": k, "cd_mm": v, "said": "x"} for k, v in enumerate((5.0, 1.0, 2.0))
    ]
    rows.append({"name": "b", "seed": 0, "cd_mm": None, "steps": 4})
    assert resumable.medians(rows) == [
        {"name": "a", "seeds": 3, "cd_mm": 2.0},
        {"name": "b", "seeds": 1, "steps": 4},
    ]


def test_a_table_of_other_settings_is_refused(table):
    fill, made, _, file = table
    fill()
    with pytest.raises(ValueError, match=r"table\.json: a table with minutes 3\.0 \(now 1\.0\)"):
        fill(minutes=1.0)
    before = file.read_text()
    fill(jobs=[{"name": "a", "seed": 1}])  # fewer are asked for: the others stay
    assert file.read_text() == before
    assert len(made) == 6


def test_shared_options(resumable):
    parser = argparse.ArgumentParser()
    resumable.add_options(parser, ("x", "y"), minutes=3)
    chosen = parser.parse_args(["--only", "y", "--seeds", "1"])
    assert (chosen.only, chosen.seeds, chosen.minutes) == (["y"], 1, 3)
    with pytest.raises(SystemExit):
        parser.parse_args(["--only", "z"])


@pytest.mark.parametrize(("minutes", "small"), [(3.0, 1.0), ((1.0, 30.0), [1.0])])
def test_quick_is_the_same_size_in_every_table(resumable, monkeypatch, minutes, small):
    parser = argparse.ArgumentParser()
    resumable.add_options(parser, ("x", "y"), minutes=minutes)
    monkeypatch.setattr(sys, "argv", ["table.py", "--quick"])
    asked = resumable.read_options(parser)
    assert (asked.seeds, asked.eval_frames, asked.minutes) == (1, 1, small)


def test_a_body_judged_by_itself_is_near(resumable):
    body = xa.synthetic_body()
    params = xa.BodyParams.create(body, pose=np.zeros((1, body.num_joints, 3)))
    frames = frames_from_params(body, params)

    class Truth:
        def __init__(self):
            self.body = body

        def surface(self, params, *, mode="fast"):
            return xa.Mesh(np.asarray(frames[0].vertices), np.asarray(frames[0].faces))

        def posed_template(self, params):
            return np.asarray(frames[0].vertices)

    figures = resumable.score(Truth(), frames, 1)
    assert figures["cd_hands_mm"] < 1e-3
    assert figures["iou_all"] == 1.0
