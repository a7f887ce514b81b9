"""Metrics of one mesh, their mean over frames, and their JSON form."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

REGIONS = ("all", "hands", "face")
"""Regions that every metric is given for."""


@dataclass(frozen=True)
class RegionValues:
    """One metric of the whole mesh, both hands and the face; NaN where nothing was measured."""

    all: float | int
    hands: float | int
    face: float | int

    def to_json(self) -> dict[str, Any]:
        """The three values by name, None for NaN."""
        return {region: null_if_nan(getattr(self, region)) for region in REGIONS}


@dataclass(frozen=True)
class MeshMetrics:
    """Metrics of a mesh against the ground truth.

    - `cd_mm`: Chamfer distance, mean of both directions' means, not squared, mm.
    - `cd_max_mm`: mean of both directions' maxima, mm.
    - `nc`: normal consistency, mean absolute cosine, 0 to 1.
    - `iou`: volumetric intersection over union in the region's box.
    - `iou_near`: the same at points within about a centimetre of either surface.
    - `iou_box`: intersection over union of axis-aligned boxes.
    - `count`: surface samples of both meshes; summed when records are averaged.
    """

    cd_mm: RegionValues
    cd_max_mm: RegionValues
    nc: RegionValues
    iou: RegionValues
    iou_near: RegionValues
    iou_box: RegionValues
    count: RegionValues

    def to_json(self) -> dict[str, dict[str, Any]]:
        """Nested dictionaries by metric and region; None for NaN, counts as integers."""
        record = {field.name: getattr(self, field.name).to_json() for field in fields(self)}
        record["count"] = {region: int(n) for region, n in record["count"].items()}
        return record


def null_if_nan(value: float | int) -> float | None:
    """`value`, or None if it is NaN, which JSON cannot hold."""
    return None if math.isnan(value) else float(value)


def mean_metrics(records: Sequence[MeshMetrics]) -> MeshMetrics:
    """Mean of each metric over the records that have it, else NaN; counts are summed.

    **Raises:** `ValueError` if there are no records.
    """
    if not records:
        raise ValueError("no records to average: evaluate at least one frame.")

    def mean(name: str, region: str) -> float | int:
        values = [getattr(getattr(record, name), region) for record in records]
        measured = [value for value in values if not math.isnan(value)]
        total = math.fsum(measured)
        if name == "count":
            return int(total)
        return total / len(measured) if measured else math.nan

    names = [field.name for field in fields(MeshMetrics)]
    return MeshMetrics(**{n: RegionValues(**{r: mean(n, r) for r in REGIONS}) for n in names})
