"""Labelled points of one frame, with so many for each part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..body import BODY, EYES_MOUTH, FACE, LEFT_HAND, RIGHT_HAND
from ..frames import Frame
from ..geometry import face_areas
from .labels import signed_distance


@dataclass(frozen=True)
class SamplingPlan:
    """How many points a frame gives, by part, and how far from the surface they lie.

    - `body`, `face`, `eyes_mouth`, `hand` (each): counts; `box`: uniform in the frame's box.
    - `sigma`: standard deviations in metres of the normal noise, taken in turn by a
      part's points; `fine_sigma`: the same for hands, face, eyes and mouth.
    - `by_vertex`: draw vertices uniformly, as the released code does; else points by area.
    - `uniform`: forget the parts and draw as many points from the whole surface (ablation A3);
      each keeps the noise of the part that it lies on, and its label.
    - `box_margin`: metres around the frame's bounding box.
    """

    body: int = 2000
    face: int = 1000
    eyes_mouth: int = 1000
    hand: int = 1000
    box: int = 0
    sigma: tuple[float, ...] = (0.01,)
    fine_sigma: tuple[float, ...] = (0.01,)
    by_vertex: bool = True
    uniform: bool = False
    box_margin: float = 0.1

    @property
    def total(self) -> int:
        """Points a frame."""
        return self.body + self.face + self.eyes_mouth + 2 * self.hand + self.box

    def counts(self) -> dict[int, int]:
        """Points by part label."""
        return {
            BODY: self.body,
            FACE: self.face,
            EYES_MOUTH: self.eyes_mouth,
            LEFT_HAND: self.hand,
            RIGHT_HAND: self.hand,
        }


class FrameSamples(NamedTuple):
    """Points of one frame, in metres, and what is known of them.

    - `points`: `(N, 3)`; `parts`: `(N,)` the label that starts their search.
    - `distance`: `(N,)` to the surface, positive inside.
    """

    points: Float[np.ndarray, "N 3"]
    parts: Int[np.ndarray, " N"]
    distance: Float[np.ndarray, " N"]


def sample_frame(
    frame: Frame,
    labels: Int[np.ndarray, " V"],
    plan: SamplingPlan,
    rng: np.random.Generator,
) -> FrameSamples:
    """Draw `plan.total` labelled points of one frame, in the frame's own world.

    A part that the frame lacks gives its points to the body, so that counts stay fixed.
    """
    vertices, faces = np.asarray(frame.vertices, np.float64), np.asarray(frame.faces)
    # A triangle belongs to the part of its first vertex: borders are a triangle wide.
    place_labels, areas = labels[faces[:, 0]], face_areas(vertices, faces)
    surface = np.unique(faces)  # its vertices: others may lie anywhere
    if plan.by_vertex:
        place_labels = labels[surface]
    points, parts = [], []
    counts = plan.counts()
    if plan.uniform:
        counts = {BODY: sum(counts.values())}
    for part, count in counts.items():
        if not count:
            continue
        every = np.arange(len(place_labels))
        own = every if plan.uniform else np.flatnonzero(place_labels == part)
        if not len(own):
            own = np.flatnonzero(place_labels == BODY)
            own = own if len(own) else every
        if plan.by_vertex:
            place = own[rng.integers(0, len(own), count)]
            drawn = vertices[surface[place]]
        else:
            drawn, place = _on_triangles(vertices, faces, areas, own, count, rng)
        sigmas = plan.sigma if part == BODY else plan.fine_sigma
        spread = np.resize(np.asarray(sigmas), count)[:, None]
        if plan.uniform:
            fine = np.resize(np.asarray(plan.fine_sigma), count)[:, None]
            spread = np.where((place_labels[place] == BODY)[:, None], spread, fine)
        points.append(drawn + spread * rng.standard_normal((count, 3)))
        parts.append(place_labels[place])
    if plan.box:
        used = vertices[surface]
        low, high = used.min(0) - plan.box_margin, used.max(0) + plan.box_margin
        points.append(rng.uniform(low, high, (plan.box, 3)))
        parts.append(np.full(plan.box, BODY))
    all_points = np.concatenate(points)
    distance = signed_distance(vertices, faces, all_points)
    return FrameSamples(
        all_points.astype(np.float32),
        np.concatenate(parts).astype(np.int32),
        distance.astype(np.float32),
    )


def _on_triangles(
    vertices: np.ndarray,
    faces: np.ndarray,
    areas: np.ndarray,
    own: np.ndarray,
    count: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Points uniform by area on the chosen triangles, and the triangle of each."""
    cumulative = np.cumsum(areas[own])
    face = own[np.searchsorted(cumulative, rng.uniform(0, cumulative[-1], count), side="right")]
    u, v = rng.uniform(size=(2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = (vertices[faces[face, k]] for k in range(3))
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), face
