"""Surface samples of one mesh against the other: distances and normals."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..geometry import ClosestPointTree, face_normals, sample_surface
from ..meshing import Mesh


class SurfaceSamples(NamedTuple):
    """Samples of one mesh, measured against the other mesh.

    Attributes:
        points: positions (N, 3), metres.
        distance: to the closest point of the other mesh (N,), metres.
        cosine: absolute cosine between both face normals (N,); NaN at a degenerate triangle.
        labels: part of the nearest label vertex (N,), -1 if there are no labels.
    """

    points: Float[np.ndarray, "N 3"]
    distance: Float[np.ndarray, "N"]
    cosine: Float[np.ndarray, "N"]
    labels: Int[np.ndarray, "N"]


def measure_samples(
    mesh: Mesh, other: Mesh, tree: ClosestPointTree, num_samples: int, rng: np.random.Generator
) -> SurfaceSamples:
    """Sample `mesh` and measure against `other`, over which `tree` is built."""
    points, face = sample_surface(mesh.vertices, mesh.faces, num_samples, rng)
    closest = tree.query(points)
    normal = face_normals(mesh.vertices, mesh.faces[face])
    other_normal = face_normals(other.vertices, other.faces[closest.face])
    cosine = np.abs((normal * other_normal).sum(axis=1))
    # A triangle without area has no normal: not a wrong one.
    cosine[~(normal.any(axis=1) & other_normal.any(axis=1))] = np.nan
    return SurfaceSamples(points, closest.distance, cosine, np.full(num_samples, -1))


def chamfer(
    first: SurfaceSamples, second: SurfaceSamples, masks: list[Bool[np.ndarray, "N"]]
) -> tuple[float, float, float, int]:
    """Chamfer, maximum (both metres), normal consistency and count over masked samples.

    Each figure is the mean of both directions'. If either direction has no samples, all are NaN
    and the count is 0: half a Chamfer distance is none.
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
