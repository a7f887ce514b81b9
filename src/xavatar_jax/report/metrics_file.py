"""The metrics of a run as JSON and as a table."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

from ..avatar import Avatar, BodyOnlyAvatar, Evaluation
from ..files import atomic_path
from ..metrics import REGIONS
from .machine import describe_machine

_ROWS = (
    ("cd_mm", "Chamfer (mm)", 2),
    ("cd_max_mm", "maximum (mm)", 1),
    ("nc", "normal consistency", 3),
    ("iou", "volumetric IoU", 3),
    ("iou_near", "IoU near the surface", 3),
    ("iou_box", "bounding-box IoU", 3),
)


def metrics_record(
    evaluation: Evaluation,
    before: Evaluation | None,
    avatar: Avatar | BodyOnlyAvatar,
    seconds: Mapping[str, float],
    **more: Any,
) -> dict[str, Any]:
    """The contents of `metrics.json`; `more` is added as it is."""
    machine = describe_machine()
    return {
        **evaluation.to_json(),
        "before": None if before is None else before.mean.to_json(),
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
        "preset": avatar.options.get("preset"),
        "seed": avatar.options.get("seed"),
        "steps": avatar.steps,
        "body": avatar.body.source.describe(),
        **machine,
        **more,
    }


def metrics_table(evaluation: Evaluation, before: Evaluation | None = None) -> str:
    """A table of mean metrics for all, hands and face, with those before training in brackets.

    If training poses are known, the Chamfer distance of each third of the frames follows.
    """
    head = f"{'held-out, ' + str(len(evaluation.per_frame)) + ' frames':24}"
    lines = [head + "".join(f"{region:>20}" for region in REGIONS)]
    for name, label, digits in _ROWS:
        row = f"{label:24}"
        for region in REGIONS:
            cell = f"{getattr(getattr(evaluation.mean, name), region):.{digits}f}"
            if before is not None:
                cell += f" ({getattr(getattr(before.mean, name), region):.{digits}f})"
            row += f"{cell:>20}"
        lines.append(row)
    if before is not None:
        lines.append("in brackets: before training (the body's mean shape)")
    groups = evaluation.by_pose_distance()
    if groups:
        lines.append("Chamfer (mm), by distance to the nearest training pose")
    for name, group in groups.items():
        distances = group.pose_distance or ()
        row = f"{f'{name}, {min(distances):.0f} to {max(distances):.0f} degrees':24}"
        lines.append(row + "".join(f"{getattr(group.mean.cd_mm, r):>20.2f}" for r in REGIONS))
    return "\n".join(lines)


def write_json(path: str | os.PathLike[str], record: Mapping[str, Any]) -> None:
    """Write plain values as JSON, whole or not at all. **Raises:** `ValueError` for NaN."""
    text = json.dumps(record, indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
