"""An avatar: a body, a shape and the fields learned for them."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..body import (
    BodyModel,
    BodyParams,
    bone_transforms,
    canonical_params,
    canonical_vertices,
    check_params,
    pose_body,
    with_betas,
)
from ..correspondence import RowFinder, StartSet
from ..fields import TabulatedSkinning
from ..meshing import Mesh
from ..training import AvatarFields, FitConfig
from ..training.pool import tabulate_for_search
from .animate import Animation, MotionLike, NeutralSurface, Offsets, animate, neutral_surface
from .pointwise import (
    batch_size,
    in_batches,
    logits,
    padded_size,
    project,
    skin,
    skin_weights,
)
from .query import Query, query_posed
from .rigging import GlbExport, Motions, export_glb, export_weights
from .surface import MAX_VERTICES, CellSizes, extract_around


@dataclass(frozen=True)
class Avatar:
    """A person's fields on a body. Made by `fit`, or read by `load_avatar`.

    - `betas`: the shape whose skeleton is driven, `(S,)`.
    - `fields`: skinning and geometry in the canonical space of that shape.
    - `steps`: training steps that the fields have seen.
    """

    body: BodyModel
    betas: Float[np.ndarray, " S"]
    fields: AvatarFields
    config: FitConfig
    steps: int = 0

    def skin_weights(self, points: Float[Array, "N 3"]) -> Float[Array, "N J"]:
        """Learned skinning weights at canonical points, metres."""
        return skin_weights(self.fields, jnp.asarray(points))

    def query(
        self, points: Float[Array, "N 3"], params: BodyParams, *, starts: StartSet = "part_aware"
    ) -> Query:
        """Everything the fields say of posed points: logit, canonical point, whether found.

        Differentiable in points and parameters. A point's part, which decides what starts its
        search, is that of the nearest vertex of the posed body; close to two parts it is both.
        """
        finder = self._row_finder(self.posed_template(params))
        return self._query(jnp.asarray(points, jnp.float32), params, finder, starts)

    def _query(
        self, points: Array, params: BodyParams, finder: RowFinder, starts: StartSet = "part_aware"
    ) -> Query:
        count = len(points)
        if count:
            # Sizes of a few kinds only: a search compiles for seconds.
            points = jnp.pad(points, ((0, padded_size(count) - count), (0, 0)), mode="edge")
        rows = jnp.asarray(finder(np.asarray(jax.lax.stop_gradient(points))))
        answer = query_posed(
            self.fields, self._table, self.body, points, rows, self._own(params), starts
        )
        return Query(*(leaf[:count] for leaf in answer))

    def _row_finder(self, template: Float[np.ndarray, "V 3"]) -> RowFinder:
        return RowFinder(template, np.asarray(self.body.part_labels))

    def occupancy(
        self, points: Float[Array, "N 3"], params: BodyParams, *, starts: StartSet = "part_aware"
    ) -> Float[Array, " N"]:
        """Occupancy of posed points, 0 to 1, differentiable in points and parameters.

        A point that no bone leads to a canonical point is outside: 0.
        """
        answer = self.query(points, params, starts=starts)
        return jnp.where(answer.found, jax.nn.sigmoid(answer.logit), 0.0)

    def canonical_mesh(
        self,
        params: BodyParams | None = None,
        *,
        cell: CellSizes | float | None = None,
        max_vertices: int | None = MAX_VERTICES,
    ) -> Mesh:
        """The surface in canonical space, under one frame's pose and expression if given.

        With the default cells the surface of the neutral person is extracted once; under other
        parameters its vertices move along the field's gradient on to the surface asked for, so
        that all meshes have the same faces.

        **Raises:** `EmptyLevelSetError` if there is no surface.
        """
        default = cell is None and max_vertices == MAX_VERTICES
        base = self._base_mesh if default else self._extract_canonical(cell, max_vertices)
        if params is None:
            return base
        check_params(self.body, params)
        condition = self.fields.geometry.condition(self._own(params))
        vertices = in_batches(
            lambda x: project(self.fields, x, condition), base.vertices, batch_size(self.config)
        )
        return replace(base, vertices=vertices, normals=None)

    def mesh(
        self,
        params: BodyParams,
        *,
        mode: Literal["fast", "full"] = "fast",
        cell: CellSizes | float | None = None,
        max_vertices: int | None = MAX_VERTICES,
    ) -> Mesh:
        """The posed surface of one frame, metres.

        `fast` skins the canonical mesh; its topology is the same in every frame. `full` extracts
        the posed field itself, with a search at every sample: slower by far, and right where
        parts touch.

        **Raises:** `ValueError` for parameters that do not fit the body; `EmptyLevelSetError`.
        """
        check_params(self.body, params)
        if mode == "fast":
            canonical = self.canonical_mesh(params, cell=cell, max_vertices=max_vertices)
            transforms = bone_transforms(self.body, self._own(params))
            vertices = in_batches(
                lambda x: skin(self.fields, x, transforms),
                canonical.vertices,
                batch_size(self.config),
            )
            return replace(canonical, vertices=vertices)
        if mode == "full":
            return self._extract_posed(params, cell, max_vertices)
        raise ValueError(f"unknown mode {mode!r}: fast or full")

    def animate(
        self,
        motion: MotionLike | BodyParams,
        *,
        mode: Literal["fast", "full"] = "fast",
        offsets: Offsets = "cached",
        fps: float | None = None,
    ) -> Animation:
        """The posed surface over a motion, or over parameters `(T, ...)`; nothing is computed yet.

        `fast` moves and skins one base mesh, so all frames share their faces. How its vertices
        follow pose and expression is `offsets`: `cached` takes one step along the base's normals,
        from the logits of the frame at the base, in milliseconds; `exact` is `mesh` frame by
        frame; `none` skins the neutral surface. `Animation.error` measures the difference.
        `full` extracts the posed field of each frame: see `mesh`.

        The motion's world is kept (`Motion.to_y_up` turns it), its shape gives way to the
        avatar's. `fps` replaces the motion's frame rate; parameters have none and get 30.

        **Raises:** `ValueError` for parameters that do not fit the body or are not finite, or a
        frame rate that is not positive; `TypeError` for something else than a motion.
        """
        return animate(self, motion, mode=mode, offsets=offsets, fps=fps)

    def export_glb(
        self,
        path: str | os.PathLike[str],
        motion: Motions | None = None,
        *,
        influences: Literal[4, 8] = 4,
        expressions: bool | int = True,
        colors: UInt8[np.ndarray, "V C"] | None = None,
        up: Literal["y", "z"] | None = None,
        verbose: bool = True,
    ) -> GlbExport:
        """Write a rigged `.glb`: mesh, skeleton, weights, expressions as blend shapes, clips.

        `motion` is one motion, parameters `(T, ...)` at 30 frames a second, or several by the
        names that their clips get. The file is in metres with y up, whatever the motions' own up
        axis (`up` for parameters, else y). Eight `influences` lose less than four; Blender reads
        them, three.js takes the first four. `expressions`: how many coefficients get blend shapes,
        the first ones (True: all; False or 0: none). `colors` are sRGB, one row a vertex of
        `canonical_mesh()`, in place of the mesh's own.

        What the file loses against `animate` is measured on 24 frames, returned, and printed
        unless `verbose` is false. The file appears whole or not at all.

        **Raises:** `ValueError` for a name that does not end in `.glb`, or as for `animate`;
        `OSError` if the file cannot be written.
        """
        return export_glb(
            self,
            path,
            motion,
            influences=influences,
            expressions=expressions,
            colors=colors,
            up=up,
            verbose=verbose,
        )

    def export_weights(self, path: str | os.PathLike[str]) -> None:
        """Write the neutral mesh's skinning to a plain `.npz`: see `export.write_weights`.

        **Raises:** `OSError` if the file cannot be written.
        """
        export_weights(self, path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the avatar to one file, without the body's arrays: see `load_avatar`."""
        from .store import save_avatar

        save_avatar(self, path)

    @cached_property
    def _table(self) -> TabulatedSkinning:
        return tabulate_for_search(self.body, self.betas, self.fields.skinning, self.config)

    @cached_property
    def neutral_surface(self) -> NeutralSurface:
        """What `animate` keeps between frames and motions, made on first use."""
        return neutral_surface(self)

    @cached_property
    def _base_mesh(self) -> Mesh:
        return self._extract_canonical(None, MAX_VERTICES)

    @cached_property
    def _canonical_vertices(self) -> Float[np.ndarray, "V 3"]:
        return np.asarray(canonical_vertices(self.body, jnp.asarray(self.betas)), np.float64)

    def _own(self, params: BodyParams) -> BodyParams:
        """Parameters with the avatar's shape in place of theirs: fields know one skeleton."""
        return with_betas(params, self.betas)

    def posed_template(self, params: BodyParams) -> Float[np.ndarray, "V 3"]:
        """Vertices of the body itself in this pose and the avatar's shape, metres."""
        own = jax.lax.stop_gradient(self._own(params))
        return np.asarray(_posed(self.body, own), np.float64)

    def _extract_canonical(self, cell: CellSizes | float | None, max_vertices: int | None) -> Mesh:
        neutral = canonical_params(self.body, jnp.asarray(self.betas))
        geometry = self.fields.geometry
        condition = geometry.without_zeros(geometry.condition(neutral))

        def field(points: np.ndarray) -> np.ndarray:
            return np.asarray(logits(self.fields, jnp.asarray(points), condition))

        return extract_around(
            self.body,
            self._canonical_vertices,
            field,
            cell,
            max_vertices,
            margin=self.config.skinning.grid.band,
            batch=batch_size(self.config),
            edge_steps=0,
            project_steps=1,
        )

    def _extract_posed(
        self, params: BodyParams, cell: CellSizes | float | None, max_vertices: int | None
    ) -> Mesh:
        template = self.posed_template(params)
        finder = self._row_finder(template)

        def field(points: np.ndarray) -> np.ndarray:
            answer = self._query(jnp.asarray(points, jnp.float32), params, finder)
            # Nowhere to be found is outside, by about the width of the learned step.
            return np.asarray(jnp.where(answer.found, answer.logit, -10.0))

        return extract_around(
            self.body,
            template,
            field,
            cell,
            max_vertices,
            margin=self.config.skinning.grid.band,
            batch=4096,
        )


_posed = eqx.filter_jit(lambda body, params: pose_body(body, params).vertices)
