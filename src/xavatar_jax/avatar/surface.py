"""The surface of a field around a body: cells as fine as each part of it asks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..body import BODY, FACES, HANDS, BodyModel
from ..geometry import nearest_vertices
from ..meshing import Mesh, extract_surface
from ..meshing.sampler import ScalarField

MAX_VERTICES = 50_000


@dataclass(frozen=True)
class CellSizes:
    """Edges of extraction cells by part, metres."""

    body: float = 0.008
    head: float = 0.004
    face: float = 0.002
    hands: float = 0.002

    def scaled(self, factor: float) -> CellSizes:
        """All sizes times `factor`."""
        return CellSizes(*(factor * v for v in (self.body, self.head, self.face, self.hands)))


def extract_around(
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

    `margin` is what clothes and hair may need around the body, metres; other arguments are those of
    `extract_surface`.

    **Raises:** `EmptyLevelSetError` if there is no surface.
    """
    sizes = CellSizes() if cell is None else cell
    if not isinstance(sizes, CellSizes):
        sizes = CellSizes(sizes, sizes, sizes, sizes)
    wanted = _cells_by_vertex(body, sizes)

    def cell_at(points: np.ndarray) -> np.ndarray:
        return wanted[nearest_vertices(template, points)[1]]

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


def _cells_by_vertex(body: BodyModel, sizes: CellSizes) -> Float[np.ndarray, " V"]:
    labels = np.asarray(body.part_labels)
    wanted = np.full(len(labels), sizes.body)
    head = body.tree.indices("head")
    if head:
        # The whole head, ears and hair too: its shapes are finer than a limb's.
        on_head = np.asarray(body.weights)[:, body.tree.subtree(head[0])].sum(1)
        wanted[(labels == BODY) & (on_head > 0.5)] = sizes.head
    wanted[np.isin(labels, FACES)] = sizes.face
    wanted[np.isin(labels, HANDS)] = sizes.hands
    return wanted
