"""Metrics of an avatar on held-out frames."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..frames import Frames, spread
from ..learning import progress
from ..meshing import Mesh
from ..metrics import MeshMetrics, mean_metrics, surface_metrics
from ..sampling import pose_distance
from .protocol import Drivable, Mode

GROUPS = ("near", "middle", "far")


@dataclass(frozen=True)
class Evaluation:
    """The mean over frames, the metrics of each frame, and where the frames are from.

    `pose_distance`: degrees from each frame's pose to the nearest training pose, if training
    frames were given.
    """

    mean: MeshMetrics
    per_frame: tuple[MeshMetrics, ...]
    sources: tuple[str, ...]
    pose_distance: tuple[float, ...] | None = None

    def by_pose_distance(self) -> dict[str, Evaluation]:
        """Thirds of the frames, from the nearest to a training pose to the farthest.

        Fewer than three frames make fewer groups. Empty without training frames.
        """
        if self.pose_distance is None:
            return {}
        order = np.argsort(self.pose_distance, kind="stable")
        groups = {}
        for name, rows in zip(GROUPS, np.array_split(order, len(GROUPS)), strict=True):
            if len(rows):
                records = tuple(self.per_frame[k] for k in rows)
                sources = tuple(self.sources[k] for k in rows)
                distances = tuple(self.pose_distance[k] for k in rows)
                groups[name] = Evaluation(mean_metrics(records), records, sources, distances)
        return groups

    def to_json(self) -> dict[str, Any]:
        """Nested plain values: the mean's figures, `per_frame`, `frames`, `by_pose_distance`."""
        frames = [
            {"source": source, **record.to_json()}
            for source, record in zip(self.sources, self.per_frame, strict=True)
        ]
        values = {**self.mean.to_json(), "per_frame": frames, "frames": len(frames)}
        if self.pose_distance is None:
            return values
        for frame, distance in zip(frames, self.pose_distance, strict=True):
            frame["pose_distance_deg"] = distance
        groups = {}
        for name, group in self.by_pose_distance().items():
            distances = group.pose_distance or ()
            groups[name] = {
                "pose_distance_deg": [min(distances), max(distances)],
                "frames": len(distances),
                **group.mean.to_json(),
            }
        return {**values, "by_pose_distance": groups}


def evaluate(
    avatar: Drivable,
    frames: Frames,
    *,
    learned_from: Frames | None = None,
    num_frames: int | None = 24,
    mode: Mode = "fast",
    seed: int = 0,
    verbose: bool = True,
) -> Evaluation:
    """Compare an avatar's posed surfaces with the meshes of frames.

    `num_frames` are spread evenly over the sequences (None: all). Parts are those of the nearest
    vertex of the posed body, as in the reference's protocol. See `surface_metrics` for the
    figures. With `learned_from`, the training frames (`Fit.frames`; only their poses are read),
    figures are also given by the distance to the nearest training pose: see `pose_distance`.

    **Raises:** `ValueError` for fewer frames than one, or frames of another tree than the avatar's;
    `EmptyLevelSetError` if the avatar has no surface.
    """
    chosen = frames[spread(frames, num_frames)]
    distances = None
    if learned_from is not None:
        distances = tuple(pose_distance(chosen.params, learned_from.params).tolist())
    parts = avatar.body.parts
    records: list[MeshMetrics] = []
    # Metrics of a frame are computed in NumPy while JAX makes the surface of the next one.
    with (
        progress("evaluation", len(chosen), verbose=verbose, unit="frame") as bar,
        ThreadPoolExecutor(1) as worker,
    ):

        def finish(measured: Future[MeshMetrics]) -> None:
            records.append(measured.result())
            bar.update(1)

        waiting = None
        for k, frame in enumerate(chosen):
            task = partial(
                surface_metrics,
                avatar.surface(frame.params, mode=mode),
                Mesh(frame.vertices, frame.faces),
                label_vertices=avatar.posed_template(frame.params),
                labels=np.asarray(parts.labels),
                parts=parts,
                seed=seed + k,
            )
            if waiting is not None:
                finish(waiting)
            waiting = worker.submit(task)
        if waiting is not None:
            finish(waiting)
    return Evaluation(mean_metrics(records), tuple(records), chosen.sources, distances)
