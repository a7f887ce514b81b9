"""Marching cubes on a full grid: simple, and what the octree is tested against."""

import numpy as np
from numpy.typing import ArrayLike

from .extract import _check_bounds
from .mesh import Mesh
from .sampler import EmptyLevelSetError, FieldSampler, ScalarField


def marching_cubes(
    field: ScalarField,
    bounds: ArrayLike,
    cell: float,
    *,
    level: float = 0.0,
    batch_points: int = 16_384,
    verbose: bool = False,
) -> Mesh:
    """Extract the surface where `field` crosses `level` from a full grid of `cell` (metres).

    Takes `field` and `bounds` (2, 3) as `extract_surface` does; memory and time grow with the
    volume, so it is meant for small boxes.

    Raises:
        EmptyLevelSetError: if the field does not cross `level` within `bounds`.
        ValueError: if an argument has a wrong shape or sign, or the field is not finite.

    Source: Lewiner et al. 2003, by scikit-image.
    """
    from skimage.measure import marching_cubes as lewiner

    box = _check_bounds(bounds)
    if not cell > 0:
        raise ValueError(f"cell must be a positive length in metres, found {cell}.")
    sampler = FieldSampler(field, box, level=level, batch_points=batch_points, verbose=verbose)
    # One node beyond the bounds on every side, which counts as outside: the surface is closed.
    shape = np.ceil((box[1] - box[0]) / cell).astype(int) + 3
    origin = box.mean(axis=0) - 0.5 * cell * (shape - 1)
    axes = [origin[i] + cell * np.arange(shape[i]) for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = sampler(points.reshape(-1, 3)).reshape(shape)
    sampler.close()
    if not (values > 0).any() or sampler.lowest > 0:
        raise EmptyLevelSetError(
            f"the field does not cross its level between {box[0].tolist()} and {box[1].tolist()} "
            f"m: values less the level range from {sampler.lowest:.4g} to {sampler.highest:.4g}. "
            "Check the bounds and the sign of the field, or use a smaller cell."
        )
    # Values near zero would put several vertices on one node and pinch the surface.
    smallest = 1e-4 * float(np.abs(values).max())
    values = np.where(np.abs(values) < smallest, np.copysign(smallest, values), values)
    vertices, faces, _, _ = lewiner(values, 0.0, spacing=(cell,) * 3, gradient_direction="ascent")
    return Mesh((vertices + origin).astype(np.float32), faces.astype(np.int32))
