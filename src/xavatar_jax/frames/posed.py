"""Frames whose meshes are a posed body, and part labels from a posed body."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int, Int8

from ..body import BodyModel, BodyParams, pose_body
from ..geometry import nearest_vertices
from .frames import Frames


@eqx.filter_jit
def _pose(body: BodyModel, params: BodyParams):
    return pose_body(body, params).vertices


def posed_vertices(body: BodyModel, params: BodyParams) -> Float[np.ndarray, "V 3"]:
    """Vertices of the body posed with unbatched parameters, as float32 NumPy, in metres."""
    return np.asarray(_pose(body, params), np.float32)


def frames_from_params(
    body: BodyModel,
    params: BodyParams,
    *,
    sources: Sequence[str] | None = None,
    sequence_names: Sequence[str] = ("sequence",),
    sequence_index: Int[np.ndarray, " N"] | Sequence[int] | None = None,
) -> Frames:
    """Frames whose meshes are the body itself, posed on access.

    Args:
        body: provides the surface and its part labels.
        params: parameters batched over the N frames.
        sources, sequence_names, sequence_index: as for `Frames`.

    Raises:
        ValueError: as for `Frames`.
    """
    faces = np.asarray(body.faces, np.int32)
    on_host = jax.tree.map(np.asarray, params)

    def load(i: int) -> tuple[np.ndarray, np.ndarray]:
        return posed_vertices(body, on_host[i]), faces

    return Frames(
        params,
        load,
        part_labels=np.asarray(body.part_labels),
        sources=sources,
        sequence_names=sequence_names,
        sequence_index=sequence_index,
        body=body,
    )


def nearest_part_labels(
    body: BodyModel, params: BodyParams, vertices: Float[np.ndarray, "V 3"]
) -> Int8[np.ndarray, " V"]:
    """Part labels of any mesh, copied from the nearest vertex of the body in the same pose.

    Args:
        body: provides the labels.
        params: unbatched parameters of the mesh.
        vertices: metres, in the world of `params`.
    """
    _, nearest = nearest_vertices(posed_vertices(body, params), vertices)
    return np.asarray(body.part_labels, np.int8)[nearest]
