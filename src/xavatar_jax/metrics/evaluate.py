"""Metrics of one mesh against the truth, on the whole and on hands and face."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import (
    ClosestPointTree,
    WindingNumberTree,
    check_points,
    nearest_vertices,
)
from ..meshing import Mesh
from .distances import SurfaceSamples, chamfer, measure_samples
from .overlap import box_of, box_overlap, joint_box, point_overlap
from .record import MeshMetrics, RegionValues

# Labels are indices into the body's parts: body, face, left_hand, right_hand, eyes_mouth.
# Each region is one or more pieces; overlaps are taken piece by piece and averaged.
_PIECES = {"hands": ((2,), (3,)), "face": ((1, 4),)}
_NEAR_SIGMA = 0.01
_MM = 1000.0


def surface_metrics(
    prediction: Mesh,
    truth: Mesh,
    *,
    label_vertices: ArrayLike | None = None,
    labels: ArrayLike | None = None,
    num_samples: int = 10_000,
    num_volume: int = 100_000,
    num_near: int = 50_000,
    num_part_volume: int = 25_000,
    part_margin: float = 0.005,
    seed: int = 0,
) -> MeshMetrics:
    """Compare a mesh with the truth: distances, normals, overlap; all, hands and face.

    `num_samples` points, uniform by area, on either mesh go to the closest point of the *other
    whole mesh*, point to triangle. A sample belongs to a region if its nearest label vertex does;
    face means the labels face and eyes_mouth.

    Volumetric overlap (`iou`) tests points by winding number > 0.5: `num_volume` uniform in the
    joint box of both meshes, and `num_part_volume` uniform in the joint box of each hand's (or
    the face's) samples and label vertices with `part_margin` on every side. `iou_near` uses
    `num_near` surface samples, half from each mesh, moved by a Gaussian of 1 cm an axis; those of
    a region are the ones whose sample is in it. `iou_box` compares the axis-aligned boxes of the
    meshes, or of the two meshes' samples of a hand or the face. Left and right hand are averaged
    in every overlap, and pooled in every distance.

    A region without samples on either mesh has NaN and count 0.

    Args:
        prediction: mesh to judge, metres.
        truth: mesh it should equal, metres.
        label_vertices: vertices of the registered body (R, 3) that carry the labels. Default:
            the vertices of `truth`.
        labels: part of each label vertex (R,): 0 body, 1 face, 2 left hand, 3 right hand, 4 eyes
            and mouth. Without it, hands and face are not measured.
        num_samples: surface samples on either mesh.
        num_volume: points in the joint box of both meshes.
        num_near: points near the surfaces.
        num_part_volume: points in the box of each hand and of the face.
        part_margin: added to a part's box on every side, metres.
        seed: of all samples.

    Raises:
        ValueError: if labels and their vertices do not fit, or a number of samples is below 2.

    Source: Shen et al. 2023, "X-Avatar: Expressive Human Avatars". The distances and the box
    overlap are what its public evaluation computes; the volumetric overlaps are what it names.
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

    figures = _distances(samples)
    figures["iou_box"] = _box_overlaps(meshes, samples)
    inside = [WindingNumberTree(mesh.vertices, mesh.faces) for mesh in meshes]
    boxes = _volume_boxes(meshes, samples, tagged, part_margin)
    figures["iou"] = _volume_overlaps(inside, boxes, num_volume, num_part_volume, rng)
    figures["iou_near"] = _near_overlaps(inside, samples, num_near, rng)
    return MeshMetrics(**{name: RegionValues(**values) for name, values in figures.items()})


def _check_labels(
    truth: Mesh, label_vertices: ArrayLike | None, labels: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Label vertices and labels, None if there are no labels."""
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


def _distances(samples: Sequence[SurfaceSamples]) -> dict[str, dict[str, float]]:
    """Chamfer and maximum in mm, normal consistency and count of each region."""
    figures: dict[str, dict[str, float]] = {"cd_mm": {}, "cd_max_mm": {}, "nc": {}, "count": {}}
    for region in ("all", *_PIECES):
        if region == "all":
            masks = [np.ones(len(s.points), dtype=bool) for s in samples]
        else:
            part = [label for piece in _PIECES[region] for label in piece]
            masks = [np.isin(s.labels, part) for s in samples]
        mean, maximum, cosine, count = chamfer(samples[0], samples[1], masks)
        figures["cd_mm"][region], figures["cd_max_mm"][region] = mean * _MM, maximum * _MM
        figures["nc"][region], figures["count"][region] = cosine, count
    return figures


def _piece_boxes(samples: Sequence[SurfaceSamples], piece: tuple[int, ...]) -> list | None:
    """Boxes of a piece's samples on both meshes, None if either mesh has none."""
    boxes = [box_of(s.points[np.isin(s.labels, piece)]) for s in samples]
    return None if any(box is None for box in boxes) else boxes


def _box_overlaps(meshes: Sequence[Mesh], samples: Sequence[SurfaceSamples]) -> dict[str, float]:
    """Box overlap of the meshes and of each region's pieces, averaged."""
    result = {"all": box_overlap(meshes[0].bounds, meshes[1].bounds)}
    for region, pieces in _PIECES.items():
        boxes = [_piece_boxes(samples, piece) for piece in pieces]
        result[region] = _mean([box_overlap(*pair) for pair in boxes if pair is not None])
    return result


def _volume_boxes(
    meshes: Sequence[Mesh],
    samples: Sequence[SurfaceSamples],
    tagged: tuple[np.ndarray, np.ndarray] | None,
    margin: float,
) -> dict[str, list[np.ndarray]]:
    """Boxes to draw points in, for each region."""
    result = {"all": [joint_box([mesh.bounds for mesh in meshes])]}
    for region, pieces in _PIECES.items():
        result[region] = []
        for piece in pieces:
            boxes = _piece_boxes(samples, piece)
            if boxes is not None and tagged is not None:
                vertices = tagged[0][np.isin(tagged[1], piece)]
                joint = joint_box([*boxes, np.stack([vertices.min(axis=0), vertices.max(axis=0)])])
                result[region].append(joint + np.array([[-margin], [margin]]))
    return result


def _inside(trees: Sequence[WindingNumberTree], points: np.ndarray) -> list[np.ndarray]:
    """Whether each point is inside each mesh; nested pieces count as inside."""
    return [tree.query(points) > 0.5 for tree in trees]


def _volume_overlaps(
    trees: Sequence[WindingNumberTree],
    boxes: dict[str, list[np.ndarray]],
    num_volume: int,
    num_part_volume: int,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Overlap at points uniform in the boxes of each region, averaged over its boxes."""
    result = {}
    for region, region_boxes in boxes.items():
        size = (num_volume if region == "all" else num_part_volume, 3)
        points = [rng.uniform(box[0], box[1], size) for box in region_boxes]
        result[region] = _mean([point_overlap(*_inside(trees, part)) for part in points])
    return result


def _near_overlaps(
    trees: Sequence[WindingNumberTree],
    samples: Sequence[SurfaceSamples],
    num_near: int,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Overlap at jittered surface samples, half from each mesh, by the sample's label."""
    chosen = [
        rng.integers(0, len(s.points), count)
        for s, count in zip(samples, (num_near // 2, num_near - num_near // 2), strict=True)
    ]
    points = np.concatenate([s.points[c] for s, c in zip(samples, chosen, strict=True)])
    labels = np.concatenate([s.labels[c] for s, c in zip(samples, chosen, strict=True)])
    points += rng.normal(scale=_NEAR_SIGMA, size=points.shape)
    first, second = _inside(trees, points)
    result = {"all": point_overlap(first, second)}
    for region, pieces in _PIECES.items():
        masks = [np.isin(labels, piece) for piece in pieces]
        result[region] = _mean([point_overlap(first[m], second[m]) for m in masks])
    return result


def _mean(values: Sequence[float]) -> float:
    """Mean of the values that are not NaN, NaN if there are none."""
    measured = [value for value in values if not np.isnan(value)]
    return float(np.mean(measured)) if measured else np.nan
