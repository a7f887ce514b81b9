"""Random points in the volume and on the surface of a frame, by part, and on the skeleton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from numpy.typing import ArrayLike

from ..body import Parts
from ..frames import Frame
from ..geometry import ClosestPointTree, WindingNumberTree, face_areas, face_normals
from ..kinematics import KinematicTree

_STEP_OUT = 1e-4  # metres: beyond a surface, but not beyond the next one
POINTS_PER_BONE = 5


class VolumePoints(NamedTuple):
    """Points near or in a person, in any number of batch axes.

    - `x_d`: `(..., 3)` posed, metres; `part`: `(...)` part labels.
    - `distance`: `(...)` metres to the surface, positive inside.
    """

    x_d: Float[np.ndarray | Array, "*n 3"]
    part: Int[np.ndarray | Array, "*n"]
    distance: Float[np.ndarray | Array, "*n"]


class SurfacePoints(NamedTuple):
    """Points on a person's surface, in any number of batch axes.

    - `x_d`: `(..., 3)` posed, metres; `part`: `(...)` part labels.
    - `normal`: `(..., 3)` unit, outward; `color`: `(..., 3)` in 0 to 1, or None.
    - `weight`: `(...)` area that the point represents, square metres.
    """

    x_d: Float[np.ndarray | Array, "*n 3"]
    part: Int[np.ndarray | Array, "*n"]
    normal: Float[np.ndarray | Array, "*n 3"]
    color: Float[np.ndarray | Array, "*n 3"] | None
    weight: Float[np.ndarray | Array, "*n"]


@dataclass(frozen=True)
class SamplingPlan:
    """Numbers of volume points per frame, by part, and their distances from the surface.

    - `body`, `face`, `eyes_mouth`, `hand` (each): counts; `box`: uniform in the frame's box.
    - `sigma`: standard deviations of the Gaussian noise, metres; the points of a part cycle through
      them. `fine_sigma`: the same for parts of a region (hands, face, eyes and mouth).
    - `by_vertex`: draw vertices uniformly, as in the released code, instead of points by area.
    - `uniform`: draw the same total from the whole surface, regardless of the parts (ablation A3);
      the part that a point lies on still decides its noise and label.
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
        """Points per frame, for the standard parts."""
        return self.body + self.face + self.eyes_mouth + 2 * self.hand + self.box

    def counts(self, parts: Parts) -> dict[int, int]:
        """Points by part label."""
        return {
            label: getattr(self, count)
            for count in ("body", "face", "eyes_mouth", "hand")
            for label, part in enumerate(parts.table)
            if part.sampled_as == count
        }


def volume_points(
    frame: Frame, parts: Parts, plan: SamplingPlan, rng: np.random.Generator
) -> VolumePoints:
    """Draw the plan's points of one frame, in the frame's world.

    `parts` holds the labels of the frame's vertices. If the frame lacks a part, its points come
    from the body (label 0), so that all frames have the same counts.
    """
    vertices, faces = np.asarray(frame.vertices, np.float64), np.asarray(frame.faces)
    labels, fine = np.asarray(parts.labels), parts.in_region()
    # A triangle belongs to the part of its first vertex.
    place_labels, areas = labels[faces[:, 0]], face_areas(vertices, faces)
    surface = np.unique(faces)  # excludes unused vertices, which may be anywhere
    if plan.by_vertex:
        place_labels = labels[surface]
    points, part_of = [], []
    counts = plan.counts(parts)
    if plan.uniform:
        counts = {0: sum(counts.values())}
    for part, count in counts.items():
        if not count:
            continue
        every = np.arange(len(place_labels))
        own = every if plan.uniform else np.flatnonzero(place_labels == part)
        for fallback in (np.flatnonzero(place_labels == 0), every):
            own = own if len(own) else fallback
        if plan.by_vertex:
            place = own[rng.integers(0, len(own), count)]
            drawn = vertices[surface[place]]
        else:
            drawn, place = _on_triangles(vertices, faces, areas, own, count, rng)
        spread, fine_spread = (
            np.resize(np.asarray(sigmas), count)[:, None]
            for sigmas in (plan.sigma, plan.fine_sigma)
        )
        is_fine = fine[place_labels[place]] if plan.uniform else np.full(count, fine[part])
        noise = rng.standard_normal((count, 3))
        points.append(drawn + np.where(is_fine[:, None], fine_spread, spread) * noise)
        part_of.append(place_labels[place])
    if plan.box:
        used = vertices[surface]
        low, high = used.min(0) - plan.box_margin, used.max(0) + plan.box_margin
        points.append(rng.uniform(low, high, (plan.box, 3)))
        part_of.append(np.zeros(plan.box, np.int8))
    x_d = np.concatenate(points)
    distance = signed_distance(vertices, faces, x_d)
    part = np.concatenate(part_of).astype(np.int32)
    return VolumePoints(x_d.astype(np.float32), part, distance.astype(np.float32))


def surface_points(
    vertices: ArrayLike,
    faces: ArrayLike,
    parts: Parts,
    count: int,
    rng: np.random.Generator,
    *,
    colors: ArrayLike | None = None,
    densities: Sequence[float] | Float[np.ndarray, " parts"] | None = None,
) -> SurfacePoints:
    """Draw points on a mesh, with face normals, interpolated colours and part labels.

    - `parts`: holds the labels of the mesh's vertices; a triangle has the label of its first.
    - `colors`: vertex colours, uint8 `(V, 3)` or `(V, 4)`, or floats in 0 to 1.
    - `densities`: relative points per area of each part, such as `parts.densities`. Default:
      uniform. Weights compensate: their sum over the points of a region estimates its area.

    **Raises:** `ValueError` if labels or colours do not fit the vertices, or the mesh has no area.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    labels = np.asarray(parts.labels)
    shades = None if colors is None else np.asarray(colors)
    for name, values in (("part labels", labels), ("colors", shades)):
        if values is not None and len(values) != len(vertices):
            raise ValueError(f"{len(values)} {name} for {len(vertices)} vertices")
    normals = face_normals(vertices, faces)
    density = np.ones(len(parts.table)) if densities is None else np.asarray(densities)
    density = density[labels[faces[:, 0]]]
    mass = density * face_areas(vertices, faces)
    if not mass.sum() > 0:
        raise ValueError("cannot draw points on a surface without area")
    corners = vertices
    if shades is not None:
        scale = 255.0 if shades.dtype == np.uint8 else 1.0
        corners = np.concatenate([vertices, shades[:, :3] / scale], 1)
    drawn, face = _on_triangles(corners, faces, mass, np.arange(len(faces)), count, rng)
    drawn = drawn.astype(np.float32)
    return SurfacePoints(
        drawn[:, :3],
        labels[faces[face, 0]].astype(np.int32),
        normals[face].astype(np.float32),
        None if shades is None else drawn[:, 3:],
        (mass.sum() / (count * density[face])).astype(np.float32),
    )


def signed_distance(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    points: Float[np.ndarray, "N 3"],
    *,
    near: float = 0.02,
) -> Float[np.ndarray, " N"]:
    """Distance to the surface of the solid, metres, positive inside.

    A point is inside if its winding number exceeds one half, so the mesh may have holes, overlaps
    and nested pieces (eyeballs, teeth). Pieces inside the solid are not part of its surface: an
    inside point within `near` of such a piece gets the distance `near`.
    """
    winding = WindingNumberTree(vertices, faces)
    inside = winding.query(points) > 0.5
    closest = ClosestPointTree(vertices, faces).query(points)
    distance = closest.distance.copy()
    check = np.flatnonzero(inside & (distance < near))
    if len(check):
        normals = face_normals(vertices, faces)[closest.face[check]]
        beyond = closest.point[check] + _STEP_OUT * normals
        buried = winding.query(beyond) > 0.5
        distance[check[buried]] = near
    return np.where(inside, distance, -distance)


def bone_points(
    tree: KinematicTree, joints: Float[Array, "J 3"], key: PRNGKeyArray
) -> Float[Array, "n 3"]:
    """Five jittered points along each bone from parent to joint (X-Avatar's released code)."""
    parents = np.asarray(tree.parents[1:])
    share = jnp.linspace(0.0, 1.0, POINTS_PER_BONE)[None, :]
    share = share + 0.1 * jax.random.normal(key, (len(parents), POINTS_PER_BONE))
    share = jnp.clip(share, 0, 1)[..., None].astype(joints.dtype)
    start, end = joints[parents][:, None], joints[1:][:, None]
    return (start + share * (end - start)).reshape(-1, 3)


def joint_targets(tree: KinematicTree) -> tuple[np.ndarray, np.ndarray]:
    """Joints and one-hot target weights of the joint-weight term.

    Each joint is paired with its own bone and, except for the root, with its parent's: together
    they pull both weights to one half (X-Avatar's released code).
    """
    count = tree.num_joints
    where = np.concatenate([np.arange(count), np.arange(1, count)])
    bone = np.concatenate([np.arange(count), np.asarray(tree.parents[1:])])
    return where, np.eye(count, dtype=np.float32)[bone]


def _on_triangles(
    values: Float[np.ndarray, "V C"],
    faces: Int[np.ndarray, "F 3"],
    mass: Float[np.ndarray, " F"],
    own: Int[np.ndarray, " n"],
    count: int,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "N C"], Int[np.ndarray, " N"]]:
    """Vertex values at random points of the triangles `own`, and the triangle of each point.

    Triangles are drawn in proportion to `mass`, points uniformly in a triangle.
    """
    cumulative = np.cumsum(mass[own])
    face = own[np.searchsorted(cumulative, rng.uniform(0, cumulative[-1], count), side="right")]
    u, v = rng.uniform(size=(2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = (values[faces[face, k]] for k in range(3))
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), face
