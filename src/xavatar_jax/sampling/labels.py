"""Inside or outside, and how far from the surface."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ..geometry import ClosestPointTree, WindingNumberTree, face_normals

_STEP_OUT = 1e-4  # metres: beyond the surface, but on the near side of the next one


def signed_distance(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    points: Float[np.ndarray, "N 3"],
    *,
    near: float = 0.02,
) -> Float[np.ndarray, " N"]:
    """Distance to the surface of the solid, metres, positive inside.

    Inside is a winding number above one half, so the mesh may have holes, nested pieces (eyeballs,
    teeth) and overlaps. A piece that lies inside the solid is no part of its surface: an inside
    point within `near` of one gets `near`, which says "inside, and not near the surface".
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
