"""First hits and occlusion of rays, with embreex. No other file imports it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..meshing import Mesh


class Hits(NamedTuple):
    """First hits of rays.

    Attributes:
        ray: index of each ray that hits something (H,).
        face: the face it hits (H,).
        weights: barycentric weights of the face's corners (H, 3).
    """

    ray: Int[np.ndarray, "H"]
    face: Int[np.ndarray, "H"]
    weights: Float[np.ndarray, "H 3"]


def face_tuples(faces: Int[np.ndarray, "F 3"]) -> np.ndarray:
    """Faces as an object array of tuples (F,), which embreex copies three times as fast.

    Making it takes as long as copying `faces` once: worthwhile for meshes that share faces.
    """
    tuples = np.empty(len(faces), dtype=object)
    tuples[:] = [tuple(face) for face in faces.tolist()]
    return tuples


class RayScene:
    """A mesh prepared for ray queries in float32; `tuples` are its `face_tuples`, if available."""

    def __init__(self, mesh: Mesh, tuples: np.ndarray | None = None) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._scene = rtcore_scene.EmbreeScene()
        # embreex reads one element at a time; Python numbers are the fastest to read.
        vertices = mesh.vertices.astype(np.float32).astype(object)
        faces = np.ascontiguousarray(mesh.faces) if tuples is None else tuples
        self._mesh = TriangleMesh(self._scene, vertices, faces)

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

    def unblocked(
        self,
        origins: Float[np.ndarray, "N 3"],
        directions: Float[np.ndarray, "N K 3"],
        reach: float,
    ) -> Float[np.ndarray, "N"]:
        """Fraction of the K rays (unit directions) of each origin that hit nothing in `reach`."""
        count = directions.shape[1]
        origins = np.repeat(np.asarray(origins, np.float32), count, axis=0)
        directions = np.ascontiguousarray(directions.reshape(-1, 3), dtype=np.float32)
        limits = np.full(len(origins), reach, dtype=np.float32)
        blocked = self._scene.run(origins, directions, limits, query="OCCLUDED") >= 0
        return 1.0 - blocked.reshape(-1, count).mean(axis=1)


def hemisphere_directions(count: int) -> Float[np.ndarray, "N 3"]:
    """Cosine-distributed directions over the upper (+z) hemisphere; deterministic."""
    index = np.arange(count) + 0.5
    radius, angle = np.sqrt(index / count), index * (np.pi * (3.0 - np.sqrt(5.0)))
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1
    )


def tangent_frames(normals: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Orthonormal frames at unit normals: rows are tangent, bitangent and normal.

    Source: Duff et al. 2017, "Building an orthonormal basis, revisited".
    """
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    bitangent = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([tangent, bitangent, normals], axis=1)
