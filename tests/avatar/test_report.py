"""What a run writes for people and for scripts."""

import json
import math

import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.learning import History
from xavatar_jax.report import (
    loss_curves,
    metrics_record,
    metrics_table,
    preview,
    write_json,
)

FIGURES = ("cd_mm", "cd_max_mm", "nc", "iou", "iou_near", "iou_box", "count")


def test_metrics_file_holds_what_scripts_rely_on(run, tmp_path):
    evaluation = xa.evaluate(run.fit.avatar, run.test, num_frames=1, verbose=False)
    seconds = dict.fromkeys(("data", "compile", "train", "evaluate", "total"), 1.0)
    record = metrics_record(evaluation, evaluation, run.fit.avatar, seconds)
    path = tmp_path / "metrics.json"
    write_json(path, record)
    read = json.loads(path.read_text())
    for figures in (read, read["before"], read["per_frame"][0]):
        for name in FIGURES:
            assert set(figures[name]) == {"all", "hands", "face"}
    expected = {"frames", "seconds", "peak_rss_mb", "preset", "seed", "commit", "device"}
    assert expected | {"versions"} <= set(read)
    assert read["frames"] == 1
    assert read["versions"]["jax"]
    table = metrics_table(evaluation, evaluation)
    assert f"{evaluation.mean.cd_mm.hands:.2f}" in table


def test_nan_is_never_written(tmp_path):
    path = tmp_path / "bad.json"
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"value": math.nan})
    assert not path.exists()


def test_preview_shows_the_person(run):
    picture = preview(run.fit.avatar, run.test[0], size=96)
    assert picture.dtype == np.uint8
    # Body, two hands and a face, three pictures each: more than background.
    assert picture.shape[0] > 4 * 80
    assert picture.std() > 10


def test_loss_curves_are_drawn_where_the_losses_are():
    """A loss that falls by decades is a straight line from the upper left to the lower right."""
    history = History()
    for step in range(25, 501, 25):
        history.record(step, {"loss": 10 ** (-step / 125), "gradient": 1e6, "found": 1.0})
    picture = loss_curves(history, size=(700, 400)).astype(int)
    assert picture.shape == (400, 700, 3)
    red, _, blue = np.moveaxis(picture[:310], 2, 0)  # above the axis and the names
    rows, columns = np.nonzero(blue - red > 60)
    assert np.ptp(columns) > 350
    fitted = np.polyfit(columns, rows, 1)
    assert fitted[0] > 0
    assert np.abs(np.polyval(fitted, columns) - rows).max() < 4
    with pytest.raises(ValueError, match="nothing to draw"):
        loss_curves(History())
