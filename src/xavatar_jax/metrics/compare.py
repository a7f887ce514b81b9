"""Metrics of a mesh against the ground truth: all, hands and face."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from ..body import Parts
from ..body.parts import Region
from ..geometry import (
    ClosestPointTree,
    check_points,
    face_normals,
    nearest_vertices,
    sample_surface,
)
from ..meshing import Mesh
from .record import MeshMetrics, RegionValues
from .solid import Solid

# Part labels of the pieces of each region; overlaps are computed by piece and averaged.
_Regions = Mapping[Region, tuple[tuple[int, ...], ...]]
_NEAR_SIGMA = 0.01
_MM = 1000.0


class SurfaceSamples(NamedTuple):
    """Samples of one mesh, measured against the other mesh.

    - `points`: positions (N, 3), metres.
    - `distance`: to the closest point of the other mesh (N,), metres.
    - `cosine`: absolute cosine of the two face normals (N,); NaN at a degenerate triangle.
    - `labels`: part of the nearest label vertex (N,), -1 without labels.
    """

    points: Float[np.ndarray, "N 3"]
    distance: Float[np.ndarray, "N"]
    cosine: Float[np.ndarray, "N"]
    labels: Int[np.ndarray, "N"]


def measure_samples(
    mesh: Mesh, other: Mesh, tree: ClosestPointTree, num_samples: int, rng: np.random.Generator
) -> SurfaceSamples:
    """Sample `mesh` and measure the samples against `other`, the mesh of `tree`."""
    points, face = sample_surface(mesh.vertices, mesh.faces, num_samples, rng)
    closest = tree.query(points)
    normal = face_normals(mesh.vertices, mesh.faces[face])
    other_normal = face_normals(other.vertices, other.faces[closest.face])
    cosine = np.abs((normal * other_normal).sum(axis=1))
    # A triangle without area has no normal, rather than a wrong one.
    cosine[~(normal.any(axis=1) & other_normal.any(axis=1))] = np.nan
    return SurfaceSamples(points, closest.distance, cosine, np.full(num_samples, -1))


def chamfer(
    first: SurfaceSamples, second: SurfaceSamples, masks: list[Bool[np.ndarray, "N"]]
) -> tuple[float, float, float, int]:
    """Chamfer, maximum (both metres), normal consistency and count over masked samples.

    Each value is the mean of both directions. If either direction has no samples, all are NaN and
    the count is 0.
    """
    if not (masks[0].any() and masks[1].any()):
        return np.nan, np.nan, np.nan, 0
    distances = [s.distance[m] for s, m in zip((first, second), masks, strict=True)]
    cosines = [s.cosine[m] for s, m in zip((first, second), masks, strict=True)]
    cosines = [c[np.isfinite(c)] for c in cosines]
    return (
        float(np.mean([d.mean() for d in distances])),
        float(np.mean([d.max() for d in distances])),
        float(np.mean([c.mean() for c in cosines])) if all(map(len, cosines)) else np.nan,
        int(masks[0].sum() + masks[1].sum()),
    )


def point_overlap(first: Bool[np.ndarray, "N"], second: Bool[np.ndarray, "N"]) -> float:
    """Intersection over union of two inside masks; NaN if no point is inside either."""
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
    """Smallest box that contains all `boxes`."""
    stacked = np.stack(boxes)
    return np.stack([stacked[:, 0].min(axis=0), stacked[:, 1].max(axis=0)])


def surface_metrics(
    prediction: Mesh,
    truth: Mesh,
    *,
    label_vertices: ArrayLike | None = None,
    labels: ArrayLike | None = None,
    parts: Parts | None = None,
    num_samples: int = 10_000,
    num_volume: int = 100_000,
    num_near: int = 50_000,
    num_part_volume: int = 25_000,
    part_margin: float = 0.005,
    seed: int = 0,
) -> MeshMetrics:
    """Compare a mesh with the ground truth (metres): distances, normals and overlap.

    Distances: `num_samples` points, uniform by area, of each mesh to the closest point of the
    *whole* other mesh. A sample belongs to the region of its nearest label vertex; face means the
    labels face and eyes_mouth. Both hands are pooled in distances and averaged in overlaps.

    - `iou`: overlap at `num_volume` points in the joint box of the meshes, or `num_part_volume`
      points in the box, extended by `part_margin` metres, of the samples and label vertices of
      each hand or the face. A point is inside if its winding number exceeds 0.5.
    - `iou_near`: overlap at `num_near` surface samples, half from each mesh, moved by a Gaussian of
      1 cm per axis and assigned to the region of the sample.
    - `iou_box`: overlap of the axis-aligned boxes of the meshes, or of their samples of a hand or
      the face.

    A region without samples on either mesh has NaN and count 0.

    **Arguments:**

    - `label_vertices`: vertices of the registered body (R, 3). Default: those of `truth`.
    - `labels`: part of each label vertex (R,). Without it, hands and face are not measured.
    - `parts`: the parts that `labels` index. Default: those of the SMPL family.

    **Raises:** `ValueError` if labels and vertices do not fit, or a number of samples is below 2.

    Source: Shen et al. 2023, "X-Avatar: Expressive Human Avatars": distances and box overlap as in
    its public evaluation, volumetric overlaps as in its text.
    """
    if min(num_samples, num_volume, num_near, num_part_volume) < 2:
        raise ValueError("every number of samples must be 2 or more.")
    rng = np.random.default_rng(seed)
    meshes = (prediction, truth)
    tagged = _check_labels(truth, label_vertices, labels)

    trees = [ClosestPointTree(mesh.vertices, mesh.faces) for mesh in meshes]
    samples = [
        measure_samples(meshes[i], meshes[1 - i], trees[1 - i], num_samples, rng) for i in range(2)
    ]
    if tagged is not None:
        _, nearest = nearest_vertices(tagged[0], np.concatenate([s.points for s in samples]))
        split = np.split(tagged[1][nearest], 2)
        samples = [s._replace(labels=part) for s, part in zip(samples, split, strict=True)]

    pieces = (Parts(np.zeros(0, np.int8)) if parts is None else parts).regions
    figures = _distances(samples, pieces)
    figures["iou_box"] = _by_region(
        pieces,
        box_overlap(meshes[0].bounds, meshes[1].bounds),
        lambda piece: _piece_box_overlap(samples, piece),
    )
    solids = [Solid(mesh) for mesh in meshes]

    def overlap_in(box: np.ndarray, count: int) -> float:
        points = rng.uniform(box[0], box[1], (count, 3))
        return point_overlap(*(solid.contains(points) for solid in solids))

    def piece_overlap(piece: tuple[int, ...]) -> float:
        boxes = _piece_boxes(samples, piece)
        if boxes is None or tagged is None:
            return np.nan
        vertices = tagged[0][np.isin(tagged[1], piece)]
        box = joint_box([*boxes, np.stack([vertices.min(axis=0), vertices.max(axis=0)])])
        return overlap_in(box + np.array([[-part_margin], [part_margin]]), num_part_volume)

    whole = overlap_in(joint_box([mesh.bounds for mesh in meshes]), num_volume)
    figures["iou"] = _by_region(pieces, whole, piece_overlap)
    figures["iou_near"] = _near_overlaps(solids, samples, num_near, rng, pieces)
    return MeshMetrics(**{name: RegionValues(**values) for name, values in figures.items()})


def _check_labels(
    truth: Mesh, label_vertices: ArrayLike | None, labels: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Label vertices and labels, None without labels."""
    if labels is None:
        if label_vertices is not None:
            raise ValueError("label_vertices were given without labels: give both or neither.")
        return None
    vertices = truth.vertices if label_vertices is None else label_vertices
    vertices, labels = check_points(vertices, "label_vertices"), np.asarray(labels)
    if labels.shape != (len(vertices),):
        raise ValueError(
            f"labels must have one entry for each of {len(vertices)} label vertices, shape "
            f"({len(vertices)},), found {labels.shape}."
        )
    return vertices, labels.astype(np.int64)


def _distances(samples: Sequence[SurfaceSamples], regions: _Regions) -> dict[str, dict[str, float]]:
    """Chamfer and maximum in mm, normal consistency and count of each region."""
    figures: dict[str, dict[str, float]] = {"cd_mm": {}, "cd_max_mm": {}, "nc": {}, "count": {}}
    for region in ("all", *regions):
        if region == "all":
            masks = [np.ones(len(s.points), dtype=bool) for s in samples]
        else:
            part = [label for piece in regions[region] for label in piece]
            masks = [np.isin(s.labels, part) for s in samples]
        mean, maximum, cosine, count = chamfer(samples[0], samples[1], masks)
        figures["cd_mm"][region], figures["cd_max_mm"][region] = mean * _MM, maximum * _MM
        figures["nc"][region], figures["count"][region] = cosine, count
    return figures


def _piece_boxes(samples: Sequence[SurfaceSamples], piece: tuple[int, ...]) -> list | None:
    """Boxes of a piece's samples on both meshes, None if either mesh has none."""
    boxes = [box_of(s.points[np.isin(s.labels, piece)]) for s in samples]
    return None if any(box is None for box in boxes) else boxes


def _piece_box_overlap(samples: Sequence[SurfaceSamples], piece: tuple[int, ...]) -> float:
    boxes = _piece_boxes(samples, piece)
    return np.nan if boxes is None else box_overlap(*boxes)


def _by_region(
    regions: _Regions, whole: float, of_piece: Callable[[tuple[int, ...]], float]
) -> dict[str, float]:
    """`whole` for "all", and for each region the mean over its pieces, ignoring NaN."""
    result = {"all": whole}
    for region, pieces in regions.items():
        measured = [v for v in map(of_piece, pieces) if not np.isnan(v)]
        result[region] = float(np.mean(measured)) if measured else np.nan
    return result


def _near_overlaps(
    solids: Sequence[Solid],
    samples: Sequence[SurfaceSamples],
    num_near: int,
    rng: np.random.Generator,
    regions: _Regions,
) -> dict[str, float]:
    """Overlap at jittered surface samples, half from each mesh, by the sample's label."""
    chosen = [
        rng.integers(0, len(s.points), count)
        for s, count in zip(samples, (num_near // 2, num_near - num_near // 2), strict=True)
    ]
    points = np.concatenate([s.points[c] for s, c in zip(samples, chosen, strict=True)])
    labels = np.concatenate([s.labels[c] for s, c in zip(samples, chosen, strict=True)])
    points += rng.normal(scale=_NEAR_SIGMA, size=points.shape)
    first, second = (solid.contains(points) for solid in solids)
    whole = point_overlap(first, second)

    def of_piece(piece: tuple[int, ...]) -> float:
        mask = np.isin(labels, piece)
        return point_overlap(first[mask], second[mask])

    return _by_region(regions, whole, of_piece)
