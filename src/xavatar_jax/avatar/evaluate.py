"""Metrics of an avatar on frames it has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..frames import Frames, spread
from ..meshing import Mesh
from ..metrics import MeshMetrics, mean_metrics, surface_metrics
from ..training.progress import progress
from .avatar import Avatar


@dataclass(frozen=True)
class Evaluation:
    """The mean over frames, each frame's own, and which frames they were."""

    mean: MeshMetrics
    per_frame: tuple[MeshMetrics, ...]
    sources: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Nested plain values: the mean's figures, `per_frame` and `frames`."""
        frames = [
            {"source": source, **record.to_json()}
            for source, record in zip(self.sources, self.per_frame, strict=True)
        ]
        return {**self.mean.to_json(), "per_frame": frames, "frames": len(frames)}


def evaluate(
    avatar: Avatar,
    frames: Frames,
    *,
    num_frames: int | None = 24,
    mode: Literal["fast", "full"] = "fast",
    seed: int = 0,
    verbose: bool = True,
) -> Evaluation:
    """Compare posed avatar meshes with the frames' own meshes.

    `num_frames` are spread evenly over the sequences (None: all). Parts are those of the nearest
    vertex of the posed body, as in the reference's protocol. See `surface_metrics` for the
    figures.
    """
    chosen = frames[spread(frames, num_frames)]
    labels = np.asarray(avatar.body.part_labels)
    records = []
    with progress("evaluation", len(chosen), verbose=verbose, unit="frame") as bar:
        for k, frame in enumerate(chosen):
            prediction = avatar.mesh(frame.params, mode=mode)
            records.append(
                surface_metrics(
                    prediction,
                    Mesh(frame.vertices, frame.faces),
                    label_vertices=avatar.posed_template(frame.params),
                    labels=labels,
                    seed=seed + k,
                )
            )
            bar.update(1)
    return Evaluation(mean_metrics(records), tuple(records), chosen.sources)
