"""Extract a level set of a field, coarse to fine, with cell sizes that may vary in space."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..geometry import check_points
from .dual_contour import dual_polygons, triangulate
from .mesh import Mesh
from .octree import Octree, refine, root_octree
from .sampler import EmptyLevelSetError, FieldSampler, ScalarField, VectorField
from .vertex_placement import place_between, spread_and_project

_MAX_COARSE, _MAX_LEAVES = 100_000, 20_000_000


def extract_surface(
    field: ScalarField,
    bounds: ArrayLike,
    *,
    cell: float,
    cell_at: Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, "N"]] | None = None,
    level: float = 0.0,
    coarse_cell: float | None = None,
    seeds: ArrayLike | None = None,
    gradient: VectorField | None = None,
    batch_points: int = 16_384,
    max_vertices: int | None = None,
    edge_steps: int = 2,
    project_steps: int = 1,
    normals: bool = False,
    verbose: bool = False,
) -> Mesh:
    """Extract the surface where `field` crosses `level`, as a closed manifold facing outwards.

    An octree over `bounds` is refined only where the field changes sign, and contoured on its dual
    grid: no fine grid is stored, and cells of different size leave no cracks. The surface is
    followed from where it is found; a separate piece is found if it contains the centre of a
    coarse cell or a seed. A surface that reaches the bounds is closed there.

    Args:
        field: batched scalar field, positive inside, from (batch_points, 3) float32 metres to
            (batch_points,). Every call has exactly `batch_points` rows; two threads call it.
        bounds: lowest and highest corner (2, 3), metres.
        cell: edge of the finest cells, metres.
        cell_at: wanted edge of the cells at points (N, 3), metres, rounded down to `cell` times a
            power of two. Default: `cell` everywhere.
        level: value at the surface.
        coarse_cell: edge of the cells in which the search for the surface starts, metres; at most
            about half of the thinnest part without seeds. Default: `cell`, doubled
            until the first grid has at most 100,000 points.
        seeds: points (S, 3) near the surface, such as the vertices of a template. Cells around them
            are refined to twice their final size in any case.
        gradient: batched gradient of the field, (batch_points, 3) to (batch_points, 3), for
            `normals`. Default: finite differences with four evaluations.
        batch_points: rows in every call of `field` and `gradient`.
        max_vertices: if there would be more vertices, all cells are enlarged as needed.
        edge_steps: evaluations that place each vertex on its edge of the dual grid.
        project_steps: rounds that even out the triangles and return the vertices to the level set;
            they stay within a cell of their place on the edge.
        normals: also store unit normals from the field's gradient.
        verbose: show a progress bar.

    Returns:
        Mesh with float32 vertices (V, 3).

    Raises:
        EmptyLevelSetError: if the field does not cross `level` within `bounds`.
        ValueError: if an argument has a wrong shape or sign, or the field is not finite.

    Source: Schaefer and Warren 2004, "Dual marching cubes: primal contouring of dual grids".
    """
    box = _check_bounds(bounds)
    if not (math.isfinite(cell) and cell > 0):
        raise ValueError(f"cell must be a positive length in metres, found {cell}.")
    if max_vertices is not None and max_vertices < 16:
        raise ValueError(f"max_vertices must be 16 or more, found {max_vertices}.")
    if seeds is not None:
        seeds = check_points(seeds, "seeds")
    sampler = FieldSampler(
        field,
        box,
        level=level,
        batch_points=batch_points,
        gradient=gradient,
        verbose=verbose,
    )
    scale = 1.0
    try:
        while True:
            tree, pairs = _refined(sampler, cell, scale, cell_at, coarse_cell, seeds)
            # Each pair of leaves gives one vertex, so the count is known before any is placed,
            # except for the few in the middle of crowded polygons.
            count = len(pairs)
            if max_vertices is None or count <= max_vertices:
                mesh = _contoured(tree, pairs, sampler, edge_steps, project_steps, normals)
                count = mesh.num_vertices
                if max_vertices is None or count <= max_vertices:
                    return mesh
            scale *= 1.02 * math.sqrt(count / max_vertices)
    finally:
        sampler.close()


def _check_bounds(bounds: ArrayLike) -> Float[np.ndarray, "2 3"]:
    """Bounds as float64 (2, 3), lowest corner first."""
    box = np.asarray(bounds, dtype=np.float64)
    if box.shape != (2, 3):
        raise ValueError(
            f"bounds must hold the lowest and highest corner, shape (2, 3), found {box.shape}."
        )
    if not (np.isfinite(box).all() and (box[1] > box[0]).all()):
        raise ValueError(f"bounds must be finite and enclose a volume, found {box.tolist()}.")
    return box


def _refined(
    sampler: FieldSampler,
    cell: float,
    scale: float,
    cell_at: Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, "N"]] | None,
    coarse_cell: float | None,
    seeds: Float[np.ndarray, "S 3"] | None,
) -> tuple[Octree, np.ndarray]:
    """The refined octree and its leaf pairs of opposite sign."""
    finest = cell * scale
    extent = sampler.bounds[1] - sampler.bounds[0]
    if coarse_cell is None:
        depth = 0
        while np.prod(np.ceil(extent / (finest * 2**depth))) > _MAX_COARSE:
            depth += 1
    else:
        if coarse_cell < cell:
            raise ValueError(f"coarse_cell ({coarse_cell}) must not be below cell ({cell}).")
        depth = max(0, math.floor(math.log2(coarse_cell / finest) + 1e-6))
    if np.any(extent / finest * 2.0 > 2**30):
        raise ValueError(f"cell ({cell} m) is too small for bounds of {extent.tolist()} m.")

    def target_level(points: np.ndarray) -> np.ndarray:
        if cell_at is None or len(points) == 0:
            return np.zeros(len(points), dtype=np.int8)
        wanted = np.asarray(cell_at(points), dtype=np.float64)
        if wanted.shape != (len(points),) or not (wanted > 0).all():
            raise ValueError(
                f"cell_at must return positive lengths for {len(points)} points, with shape "
                f"({len(points)},), found shape {wanted.shape}."
            )
        steps = np.floor(np.log2(wanted / cell) + 1e-6)
        return np.clip(steps, 0, depth).astype(np.int8)

    tree = root_octree(sampler, finest, depth)
    pairs = refine(tree, sampler, target_level, seeds, _MAX_LEAVES)
    if len(pairs) == 0 or sampler.lowest > 0:
        where = (
            f"between {sampler.bounds[0].tolist()} and {sampler.bounds[1].tolist()} m: the "
            f"{sampler.count} values sampled, minus the level, range from {sampler.lowest:.4g} to "
            f"{sampler.highest:.4g}"
        )
        advice = (
            "Everything is inside: widen the bounds, or check the sign of the field."
            if sampler.lowest > 0
            else "Everything seen is outside: train longer, check the sign and the bounds, use a "
            "smaller coarse_cell, or pass seeds near the surface."
        )
        raise EmptyLevelSetError(f"the field does not cross its level {where}. {advice}")
    return tree, pairs


def _contoured(
    tree: Octree,
    pairs: np.ndarray,
    sampler: FieldSampler,
    edge_steps: int,
    project_steps: int,
    normals: bool,
) -> Mesh:
    """Vertices and triangles of the surface between the leaf pairs."""
    polygons = dual_polygons(tree, pairs)
    positions, values, falls = place_between(tree, sampler, polygons.leaves, edge_steps)
    sizes = tree.sizes(polygons.leaves.reshape(-1)).reshape(-1, 2).min(axis=1)
    faces, crowded = triangulate(polygons, positions)
    if len(crowded):
        corners = polygons.corners[crowded]
        used = (corners >= 0)[..., None]
        middle = (positions[corners] * used).sum(axis=1) / used.sum(axis=1)
        positions = np.concatenate([positions, middle])
        values = np.concatenate([values, sampler(middle)])
        falls = np.concatenate([falls, falls[corners[:, 0]]])
        sizes = np.concatenate([sizes, sizes[corners[:, 0]]])
    positions = spread_and_project(sampler, positions, values, falls, sizes, faces, project_steps)
    positions = np.clip(positions, *sampler.bounds)
    mesh = Mesh(positions.astype(np.float32), faces)
    if not normals:
        return mesh
    # The field grows inwards.
    outward = -sampler.gradient(positions, 0.05 * sizes)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    unit = np.divide(outward, length, out=np.zeros_like(outward), where=length > 0)
    return replace(mesh, normals=unit.astype(np.float32))
