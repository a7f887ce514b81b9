"""Overlap of two solids: at points, and of their boxes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float


def point_overlap(first: Bool[np.ndarray, "N"], second: Bool[np.ndarray, "N"]) -> float:
    """Intersection over union of two sets of points inside; NaN if no point is inside either."""
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else np.nan


def box_overlap(first: Float[np.ndarray, "2 3"], second: Float[np.ndarray, "2 3"]) -> float:
    """Intersection over union of two axis-aligned boxes; NaN if neither has a volume."""
    low, high = np.maximum(first[0], second[0]), np.minimum(first[1], second[1])
    shared = float(np.prod(np.maximum(high - low, 0.0)))
    total = float(np.prod(first[1] - first[0]) + np.prod(second[1] - second[0])) - shared
    return shared / total if total > 0 else np.nan


def box_of(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "2 3"] | None:
    """Axis-aligned box of points, None if there are none."""
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else None


def joint_box(boxes: Sequence[Float[np.ndarray, "2 3"]]) -> Float[np.ndarray, "2 3"]:
    """Smallest box round all `boxes`."""
    stacked = np.stack(boxes)
    return np.stack([stacked[:, 0].min(axis=0), stacked[:, 1].max(axis=0)])
