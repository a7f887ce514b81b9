"""`Avatar`: a person as fields on a body, and the extraction of their surface."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt8

from ..body import (
    BodyModel,
    BodyParams,
    bone_transforms,
    canonical_params,
    canonical_vertices,
    check_params,
    with_betas,
)
from ..correspondence import RowFinder, StartSet
from ..fields import (
    AbstractGeometryField,
    AbstractPointCache,
    AvatarModel,
    ModelSpec,
    grids_for_search,
    tabulate,
)
from ..frames import posed_vertices
from ..geometry import VertexTree
from ..meshing import Mesh, extract_surface
from ..meshing.sampler import ScalarField
from . import queries as at
from .animate import Animation, MotionLike, Offsets, animate
from .files import save_avatar
from .protocol import AbstractRestSurface, Mode
from .queries import PosedField, Query, SearchSpec
from .rigging import GlbExport, Motions, export_glb, export_weights

MAX_VERTICES = 50_000


@dataclass(frozen=True)
class CellSizes:
    """Edges of extraction cells by region, metres. None keeps the sizes of the body's parts.

    `head` is for vertices of the head that belong to no region; all are multiplied by `factor`.
    """

    body: float | None = None
    head: float | None = None
    face: float | None = None
    hands: float | None = None
    factor: float = 1.0

    def scaled(self, factor: float) -> CellSizes:
        """All sizes times `factor`."""
        return replace(self, factor=factor * self.factor)

    def at(self, body: BodyModel) -> Float[np.ndarray, " V"]:
        """The size at each vertex of a body."""
        given = {"body": self.body, "head": self.head, "face": self.face, "hands": self.hands}
        sizes = {name: size for name, size in given.items() if size is not None}
        weights = np.asarray(body.weights)
        return self.factor * body.parts.cell_sizes(body.tree, weights, sizes)


class FieldSurface(AbstractRestSurface):
    """The zero level set of a geometry field, and what is the same in every frame.

    - `normals`: unit gradients of the field at the vertices, inwards; `slopes`: their lengths
      before, levels per metre.
    - `levels`: the field at the vertices, for any condition.
    """

    faces: Int[np.ndarray, "F 3"]
    vertices: Float[Array, "3 V"]
    weights: Float[Array, "J V"]
    colors: UInt8[np.ndarray, "V C"] | None
    normals: Float[Array, "3 V"]
    slopes: Float[Array, " V"]
    levels: AbstractPointCache
    geometry: AbstractGeometryField
    num_expression: int = eqx.field(static=True)

    def condition(self, params: BodyParams) -> PyTree[Array]:
        return self.geometry.condition(params)

    def under(self, condition: PyTree[Array]) -> Float[Array, "3 V"]:
        """To first order: a step along each vertex's normal from where the condition carries it."""
        away = self.levels(condition) / self.slopes
        away = jnp.clip(away, -at.LARGEST_OFFSET, at.LARGEST_OFFSET)
        return self.levels.carried(condition).T - self.normals * away


@dataclass(frozen=True, eq=False)
class Avatar:
    """A person's model on a body. Made by a method (`xa.fit`), or read by `load_avatar`.

    - `betas`: the shape whose skeleton is driven, `(S,)`.
    - `model`: fields in the canonical space of that shape; `spec`: what built them.
    - `search`: how queries search.
    - `steps`: training steps that the model has seen; `method`: which method trained it.
    - `options`: the method's options as plain values. They are kept in files and never read.
    """

    body: BodyModel
    betas: Float[np.ndarray, " S"]
    model: AvatarModel
    spec: ModelSpec
    search: SearchSpec = SearchSpec()
    steps: int = 0
    method: str = "xavatar"
    options: Mapping[str, Any] = field(default_factory=dict)

    def skin_weights(self, points: Float[Array, "N 3"]) -> Float[Array, "N J"]:
        """Skinning weights at canonical points, metres."""
        return at.skin_weights(self.model, jnp.asarray(points))

    def query(
        self,
        points: Float[Array, "N 3"],
        params: BodyParams,
        *,
        starts: StartSet | None = None,
    ) -> Query:
        """The model at posed points: level, canonical point, whether there is one.

        Differentiable with respect to points and parameters. The nearest vertices of the posed
        body decide where the search of a point starts; this part runs in NumPy, outside of JAX.
        Under `jax.jit`, call `xavatar_jax.query(avatar.posed_field, points, params, parts)` with
        rows from `start_rows`. `starts` replaces that of `search`.
        """
        rows = self._row_finder(params)
        return self._query(jnp.asarray(points, jnp.float32), params, rows, starts)

    def occupancy(
        self,
        points: Float[Array, "N 3"],
        params: BodyParams,
        *,
        starts: StartSet | None = None,
    ) -> Float[Array, " N"]:
        """Probability that posed points are inside, 0 to 1; 0 where no canonical point is found.

        Differentiable with respect to points and parameters. Under `jax.jit`, call
        `xavatar_jax.occupancy` instead: see `query`.
        """
        answer = self.query(points, params, starts=starts)
        return jnp.where(answer.found, self.model.link.probability(answer.level), 0.0)

    def start_rows(
        self, points: Float[np.ndarray, "N 3"], params: BodyParams
    ) -> Int[np.ndarray, " N"]:
        """Where the search of each posed point starts, as `xavatar_jax.query` takes it.

        The part of the nearest vertex of the posed body, or a pair of parts close to both.
        """
        return self._row_finder(params)(points)

    @cached_property
    def posed_field(self) -> PosedField:
        """The avatar as a pytree, for `xavatar_jax.query` and `occupancy` under `jax.jit`."""
        grids = grids_for_search(self.model.skinning, self.body, self.betas, self.search.grid)
        table = eqx.filter_jit(tabulate)(self.model.skinning, grids)
        return PosedField(self.model, self.body, jnp.asarray(self.betas), table, self.search)

    def canonical_mesh(
        self,
        params: BodyParams | None = None,
        *,
        cell: CellSizes | float | None = None,
        max_vertices: int | None = MAX_VERTICES,
    ) -> Mesh:
        """The surface in canonical space, under the pose and expression of one frame if given.

        With the default cells the surface of the neutral person is extracted once. For other
        parameters its vertices move along the field's gradient to the surface of that frame, so
        all meshes have the same faces.

        **Raises:** `EmptyLevelSetError` if there is no surface.
        """
        default = cell is None and max_vertices == MAX_VERTICES
        base = self._base_mesh if default else self._extract_canonical(cell, max_vertices)
        if params is None:
            return base
        check_params(self.body, params)
        condition = self.model.geometry.condition(self._own(params))
        vertices = self._batched(lambda x: at.project(self.model, x, condition), base.vertices)
        return replace(base, vertices=vertices, normals=None)

    def mesh(
        self,
        params: BodyParams,
        *,
        mode: Mode = "fast",
        cell: CellSizes | float | None = None,
        max_vertices: int | None = MAX_VERTICES,
    ) -> Mesh:
        """The posed surface of one frame, metres.

        `fast` skins the canonical mesh; its faces are the same in every frame. `full` extracts
        the posed field itself, with a search at every sample. That is much slower, and right
        where parts touch.

        **Raises:** `ValueError` for parameters that do not fit the body; `EmptyLevelSetError`.
        """
        check_params(self.body, params)
        if mode == "fast":
            canonical = self.canonical_mesh(params, cell=cell, max_vertices=max_vertices)
            transforms = bone_transforms(self.body, self._own(params))
            vertices = self._batched(
                lambda x: at.skin(self.model, x, transforms), canonical.vertices
            )
            return replace(canonical, vertices=vertices)
        if mode == "full":
            return self._extract_posed(params, cell, max_vertices)
        raise ValueError(f"unknown mode {mode!r}: fast or full")

    def surface(self, params: BodyParams, *, mode: Mode = "fast") -> Mesh:
        """`mesh` with the default cells."""
        return self.mesh(params, mode=mode)

    @property
    def rest(self) -> AbstractRestSurface:
        """The neutral surface as `animate` and the exports use it, made on first access."""
        return self._rest

    @cached_property
    def _rest(self) -> AbstractRestSurface:
        neutral = canonical_params(self.body, jnp.asarray(self.betas))
        # Extraction leaves vertices near the level set. Here they lie on it.
        mesh = self.canonical_mesh(neutral)
        points = mesh.vertices
        condition = self.model.geometry.condition(neutral)
        gradient = self._batched(lambda x: at.gradients(self.model, x, condition), points)
        slopes = np.maximum(np.linalg.norm(gradient, axis=1), 1e-6)
        weights = self._batched(lambda x: at.skin_weights(self.model, x), points)
        return FieldSurface(
            faces=mesh.faces,
            vertices=jnp.asarray(points.T),
            weights=jnp.asarray(weights.T),
            colors=mesh.colors,
            normals=jnp.asarray((gradient / slopes[:, None]).T),
            slopes=jnp.asarray(slopes),
            levels=_cached_at(self.model.geometry, jnp.asarray(points)),
            geometry=self.model.geometry,
            num_expression=neutral.expression.shape[-1],
        )

    def posed_template(self, params: BodyParams) -> Float[np.ndarray, "V 3"]:
        """Vertices of the body itself in this pose and the avatar's shape, metres."""
        own = jax.lax.stop_gradient(self._own(params))
        return np.asarray(posed_vertices(self.body, own), np.float64)

    def animate(
        self,
        motion: MotionLike | BodyParams,
        *,
        mode: Mode = "fast",
        offsets: Offsets = "cached",
        fps: float | None = None,
    ) -> Animation:
        """The posed surface over a motion: see `xavatar_jax.avatar.animate`."""
        return animate(self, motion, mode=mode, offsets=offsets, fps=fps)

    def export_glb(
        self, path: str | os.PathLike[str], motion: Motions | None = None, **options: Any
    ) -> GlbExport:
        """Write a rigged `.glb`: see `xavatar_jax.avatar.export_glb`, which has the options."""
        return export_glb(self, path, motion, **options)

    def export_weights(self, path: str | os.PathLike[str]) -> None:
        """Write the skinning of the neutral mesh to an `.npz`: see `export.write_weights`.

        **Raises:** `OSError` if the file cannot be written.
        """
        export_weights(self, path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the avatar to one file, without the body's arrays: see `load_avatar`."""
        save_avatar(self, path, self.body)

    def _query(
        self, points: Array, params: BodyParams, finder: RowFinder, starts: StartSet | None = None
    ) -> Query:
        count = len(points)
        if count:
            # A search compiles for seconds: only a few sizes.
            points = jnp.pad(points, ((0, at.padded_size(count) - count), (0, 0)), mode="edge")
        rows = jnp.asarray(finder(np.asarray(jax.lax.stop_gradient(points))))
        posed = self.posed_field
        if starts is not None:
            posed = replace(posed, search=replace(self.search, starts=starts))
        answer = _query(posed, points, self._own(params), rows)
        return Query(*(leaf[:count] for leaf in answer))

    def _row_finder(self, params: BodyParams) -> RowFinder:
        return RowFinder(self.posed_template(params), self.body.parts)

    @cached_property
    def _base_mesh(self) -> Mesh:
        return self._extract_canonical(None, MAX_VERTICES)

    def _own(self, params: BodyParams) -> BodyParams:
        """Parameters with the avatar's shape: the fields know one skeleton."""
        return with_betas(params, self.betas)

    def _batched(self, function: Any, points: np.ndarray) -> np.ndarray:
        return at.in_batches(function, points, self.model.geometry.batch_points)

    def _colored(self, mesh: Mesh, x_c: Float[np.ndarray, "V 3"], params: BodyParams) -> Mesh:
        """The mesh with the colours of its vertices' canonical points, if there are colours."""
        if self.model.color is None:
            return mesh
        condition = self.model.geometry.condition(params)
        rgb = self._batched(lambda x: at.colors(self.model, x, condition), x_c)
        return replace(mesh, colors=np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8))

    def _extract_canonical(self, cell: CellSizes | float | None, max_vertices: int | None) -> Mesh:
        neutral = canonical_params(self.body, jnp.asarray(self.betas))
        geometry = self.model.geometry
        condition = geometry.without_zeros(geometry.condition(neutral))
        mesh = _extract_around(
            self.body,
            np.asarray(canonical_vertices(self.body, jnp.asarray(self.betas)), np.float64),
            lambda x: np.asarray(at.levels(self.model, jnp.asarray(x), condition)),
            cell,
            max_vertices,
            margin=self.spec.skinning.grid.band,
            batch=geometry.batch_points,
            edge_steps=0,
            project_steps=1,
        )
        return self._colored(mesh, mesh.vertices, neutral)

    def _extract_posed(
        self, params: BodyParams, cell: CellSizes | float | None, max_vertices: int | None
    ) -> Mesh:
        finder = self._row_finder(params)

        def field(points: np.ndarray) -> np.ndarray:
            answer = self._query(jnp.asarray(points, jnp.float32), params, finder)
            return np.asarray(jnp.where(answer.found, answer.level, self.model.link.outside))

        mesh = _extract_around(
            self.body,
            self.posed_template(params),
            field,
            cell,
            max_vertices,
            margin=self.spec.skinning.grid.band,
            batch=4096,
        )
        if self.model.color is None:
            return mesh
        x_c = self._query(jnp.asarray(mesh.vertices, jnp.float32), params, finder).x_c
        return self._colored(mesh, np.asarray(x_c), self._own(params))


_query = eqx.filter_jit(at.query)
_cached_at = eqx.filter_jit(lambda geometry, points: geometry.at(points))


def _extract_around(
    body: BodyModel,
    template: Float[np.ndarray, "V 3"],
    field: ScalarField,
    cell: CellSizes | float | None,
    max_vertices: int | None,
    *,
    margin: float,
    batch: int,
    edge_steps: int = 2,
    project_steps: int = 0,
) -> Mesh:
    """The largest piece of the field's surface around `template`, the body's vertices (metres).

    `margin` is room for clothes and hair around the body, metres; other arguments are those of
    `extract_surface`.

    **Raises:** `EmptyLevelSetError` if there is no surface.
    """
    if cell is None or isinstance(cell, CellSizes):
        wanted = (cell or CellSizes()).at(body)
    else:
        wanted = np.full(body.num_vertices, float(cell))

    tree = VertexTree(template)

    def cell_at(points: np.ndarray) -> np.ndarray:
        return wanted[tree.query(points)[1]]

    mesh = extract_surface(
        field,
        np.stack([template.min(0) - margin, template.max(0) + margin]),
        cell=float(wanted.min()),
        cell_at=cell_at if np.ptp(wanted) > 0 else None,
        seeds=template,
        batch_points=batch,
        max_vertices=max_vertices,
        edge_steps=edge_steps,
        project_steps=project_steps,
    )
    return mesh.largest_component()
