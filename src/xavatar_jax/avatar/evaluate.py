"""Metrics of an avatar on frames it has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float

from ..body import BodyModel, BodyParams
from ..frames import Frames, spread
from ..meshing import Mesh
from ..metrics import MeshMetrics, mean_metrics, surface_metrics
from ..sampling import pose_distance
from ..training.progress import progress

GROUPS = ("near", "middle", "far")


class Posable(Protocol):
    """What can be evaluated: a person's surface in any pose of a body. An `Avatar` is one."""

    @property
    def body(self) -> BodyModel:
        """The body that parameters are for, which tells hands and face from the rest."""
        ...

    def mesh(self, params: BodyParams, *, mode: Literal["fast", "full"] = "fast") -> Mesh:
        """The posed surface of one frame, metres."""
        ...

    def posed_template(self, params: BodyParams) -> Float[np.ndarray, "V 3"]:
        """Vertices of the body itself in this pose and the person's shape, metres."""
        ...


@dataclass(frozen=True)
class Evaluation:
    """The mean over frames, each frame's own, and which frames they were.

    `pose_distance`: degrees from each frame's pose to the nearest training pose, where those
    were given.
    """

    mean: MeshMetrics
    per_frame: tuple[MeshMetrics, ...]
    sources: tuple[str, ...]
    pose_distance: tuple[float, ...] | None = None

    def by_pose_distance(self) -> dict[str, Evaluation]:
        """Thirds of the frames, from those nearest to a training pose to those farthest from one.

        Fewer than three frames make fewer groups. Empty if training poses were not given.
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
    avatar: Posable,
    frames: Frames,
    *,
    learned_from: Frames | None = None,
    num_frames: int | None = 24,
    mode: Literal["fast", "full"] = "fast",
    seed: int = 0,
    verbose: bool = True,
) -> Evaluation:
    """Compare posed avatar meshes with the frames' own meshes.

    `avatar` is an `Avatar`, or anything else that gives a mesh for a pose (`Posable`).
    `num_frames` are spread evenly over the sequences (None: all). Parts are those of the nearest
    vertex of the posed body, as in the reference's protocol. See `surface_metrics` for the
    figures. With `learned_from`, the frames of training (`Fit.frames`; only their poses are
    read), figures are also given by how far a pose is from those learned: see `pose_distance`.

    **Raises:** `ValueError` for fewer frames than one, or frames of another tree than the avatar's;
    `EmptyLevelSetError` if the avatar has no surface.
    """
    chosen = frames[spread(frames, num_frames)]
    distances = None
    if learned_from is not None:
        distances = tuple(pose_distance(chosen.params, learned_from.params).tolist())
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
    return Evaluation(mean_metrics(records), tuple(records), chosen.sources, distances)
