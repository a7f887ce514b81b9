"""The table of a run's figures, on made-up ones."""

from __future__ import annotations

from xavatar_jax.avatar import Evaluation
from xavatar_jax.metrics import MeshMetrics, RegionValues
from xavatar_jax.report import metrics_table


def metrics(value: float) -> MeshMetrics:
    return MeshMetrics(*(RegionValues(value, 2 * value, 3 * value) for _ in range(7)))


def test_thirds_by_distance_of_pose_follow_the_means():
    distances = (30.0, 4.0, 11.0)
    records = tuple(metrics(d / 10) for d in distances)
    table = metrics_table(Evaluation(metrics(1.5), records, ("a", "b", "c"), distances))
    lines = [line.split() for line in table.splitlines()]
    assert lines[-4][:3] == ["Chamfer", "(mm),", "by"]
    assert lines[-3] == ["near,", "4", "to", "4", "degrees", "0.40", "0.80", "1.20"]
    assert lines[-2] == ["middle,", "11", "to", "11", "degrees", "1.10", "2.20", "3.30"]
    assert lines[-1] == ["far,", "30", "to", "30", "degrees", "3.00", "6.00", "9.00"]


def test_without_training_poses_there_are_no_thirds():
    table = metrics_table(Evaluation(metrics(1.5), (metrics(1.5),), ("a",)))
    assert "degrees" not in table
    assert table.splitlines()[-1].startswith("bounding-box IoU")
