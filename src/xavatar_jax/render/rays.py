"""The one place that knows embreex: first hits and occlusion of rays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..meshing import Mesh


class Hits(NamedTuple):
    """First hits of rays.

    Attributes:
        ray: index of each ray that hit something (H,).
        face: face that it hit (H,).
        weights: barycentric weights of the face's corners (H, 3).
    """

    ray: Int[np.ndarray, "H"]
    face: Int[np.ndarray, "H"]
    weights: Float[np.ndarray, "H 3"]


class RayScene:
    """A mesh ready for rays, in float32."""

    def __init__(self, mesh: Mesh) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._scene = rtcore_scene.EmbreeScene()
        vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
        self._mesh = TriangleMesh(self._scene, vertices, np.ascontiguousarray(mesh.faces))

    def first_hits(
        self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"]
    ) -> Hits:
        """First hits of rays from one origin."""
        directions = np.ascontiguousarray(directions, dtype=np.float32)
        origins = np.broadcast_to(np.asarray(origin, np.float32), directions.shape)
        found = self._scene.run(np.ascontiguousarray(origins), directions, output=1)
        ray = np.flatnonzero(found["primID"] >= 0)
        u, v = found["u"][ray], found["v"][ray]
        return Hits(ray, found["primID"][ray], np.stack([1.0 - u - v, u, v], axis=1))

    def occluded(
        self,
        origins: Float[np.ndarray, "N 3"],
        directions: Float[np.ndarray, "N 3"],
        reach: float,
    ) -> Bool[np.ndarray, "N"]:
        """Whether each ray meets the mesh within `reach` metres (unit directions)."""
        origins = np.ascontiguousarray(origins, dtype=np.float32)
        directions = np.ascontiguousarray(directions, dtype=np.float32)
        limits = np.full(len(origins), reach, dtype=np.float32)
        return self._scene.run(origins, directions, limits, query="OCCLUDED") >= 0


def hemisphere_directions(count: int) -> Float[np.ndarray, "N 3"]:
    """Directions over the upper (+z) hemisphere, as dense as the cosine; nothing random."""
    index = np.arange(count) + 0.5
    radius, angle = np.sqrt(index / count), index * (np.pi * (3.0 - np.sqrt(5.0)))
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1
    )


def tangent_frames(normals: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Rows tangent, bitangent, normal of an orthonormal frame at each unit normal.

    Source: Duff et al. 2017, "Building an orthonormal basis, revisited".
    """
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    bitangent = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([tangent, bitangent, normals], axis=1)
