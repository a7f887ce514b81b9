"""A mesh made ready to be drawn: what every point that a ray hits is asked for."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..geometry import corner_matrix, face_normals, vertex_normals
from ..meshing import Mesh
from .camera import Camera
from .light import SKY_RAYS, key_visibility, openness, to_linear
from .rays import Hits, RayScene

# Of more vertices than this, and one more for so many rays, only some are asked what they see:
# averages over neighbours fill in the others.
_MANY, _RAYS_A_VERTEX = 8000, 20
_SMOOTHINGS = 3


class Points(NamedTuple):
    """Points of the surface: linear albedo and unit normals that face the eye."""

    albedo: Float[np.ndarray, "H 3"]
    normal: Float[np.ndarray, "H 3"]


class Subject:
    """A mesh with what all its pictures share: rays, normals, colours, openness to the sky.

    Args:
        mesh: its own normals are used if it has them, its colours if it has any.
        base_color: sRGB in 0 to 1, where the mesh has no colours.
    """

    def __init__(self, mesh: Mesh, base_color: tuple[float, float, float]) -> None:
        self.mesh = mesh
        self.scene = RayScene(mesh)
        normals = mesh.normals
        if normals is None:
            normals = vertex_normals(mesh.vertices, mesh.faces)
        self.extent = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
        self._base = to_linear(np.asarray(base_color)).astype(np.float32)
        self._channels = np.asarray(normals, dtype=np.float32)
        if mesh.colors is not None:
            albedo = to_linear(np.arange(256) / 255.0).astype(np.float32)[mesh.colors[:, :3]]
            self._channels = np.concatenate([self._channels, albedo], axis=1)
        # Not a number where nobody has asked yet.
        self._sky = np.full(mesh.num_vertices, np.nan, dtype=np.float32)

    def points(self, hits: Hits, toward_eye: Float[np.ndarray, "H 3"]) -> Points:
        """Colours and normals at the hits, from the corners of the faces hit."""
        found = self._at_hits(self._channels, hits)
        normal = found[:, :3]
        flat = face_normals(self.mesh.vertices, self.mesh.faces[hits.face]).astype(np.float32)
        length = np.sqrt(_dot(normal, normal))[:, None]
        normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), flat)
        # What is seen faces the eye: the inside of an open mesh is lit like the outside.
        normal = np.where(_dot(flat, toward_eye)[:, None] < 0, -normal, normal)
        if found.shape[1] == 3:
            return Points(np.broadcast_to(self._base, normal.shape), normal)
        return Points(found[:, 3:], normal)

    def visibilities(
        self, hits: Hits, camera: Camera
    ) -> tuple[Float[np.ndarray, "H"], Float[np.ndarray, "H"]]:
        """How much of the sky and of the key light the hits see, 0 to 1.

        Visibility is smooth: at the vertices of the faces seen it costs less, and averages over
        neighbours take out what few rays leave of noise.
        """
        seen = np.zeros(self.mesh.num_faces, dtype=bool)
        seen[hits.face] = True
        faces = self.mesh.faces[seen]
        marked = np.zeros(self.mesh.num_vertices, dtype=bool)
        marked[faces.reshape(-1)] = True
        used = np.flatnonzero(marked)
        every = 1 + len(used) // (_MANY + len(hits.ray) // _RAYS_A_VERTEX)
        asked = used[used % every == 0]
        lift = 2e-3 * self.extent
        points = self.mesh.vertices.astype(np.float32)
        outward = self._channels[:, :3]
        new = asked[np.isnan(self._sky[asked])]
        if len(new):
            self._sky[new] = openness(
                self.scene,
                points[new],
                outward[new],
                count=SKY_RAYS,
                reach=0.25 * self.extent,
                lift=lift,
            )
        both = np.full((self.mesh.num_vertices, 2), np.nan, dtype=np.float32)
        both[asked, 0] = self._sky[asked]
        both[asked, 1] = key_visibility(
            self.scene, points[asked], outward[asked], camera, reach=self.extent, lift=lift
        )
        number = np.zeros(self.mesh.num_vertices, dtype=np.int32)
        number[used] = np.arange(len(used), dtype=np.int32)
        spread = np.ones((self.mesh.num_vertices, 2), dtype=np.float32)
        spread[used] = _smoothed(both[used], number[faces], _SMOOTHINGS)
        found = self._at_hits(spread, hits)
        return found[:, 0], found[:, 1]

    def _at_hits(
        self, per_vertex: Float[np.ndarray, "V C"], hits: Hits
    ) -> Float[np.ndarray, "H C"]:
        corners, weights = self.mesh.faces[hits.face], hits.weights.astype(np.float32)
        out = weights[:, :1] * per_vertex[corners[:, 0]]
        out += weights[:, 1:2] * per_vertex[corners[:, 1]]
        out += weights[:, 2:] * per_vertex[corners[:, 2]]
        return out


def _smoothed(
    values: Float[np.ndarray, "V C"], faces: Int[np.ndarray, "F 3"], times: int
) -> Float[np.ndarray, "V C"]:
    """Averages over the faces around each vertex, several times; what is not a number is left
    out, and 1 where no neighbour knows."""
    known = np.isfinite(values[:, :1]).astype(np.float32)
    # The last column counts.
    sums = np.concatenate([np.nan_to_num(values), known], axis=1)
    corners = corner_matrix(faces, len(values), sums.dtype)
    for _ in range(times):
        sums = corners @ (corners.T @ sums)
        sums /= np.maximum(sums[:, -1:], 1e-6)
        sums[:, -1] = sums[:, -1] > 0.5
    found = sums[:, -1:] > 0
    return np.where(found, sums[:, :-1], 1.0).astype(np.float32)


def _dot(a: Float[np.ndarray, "N 3"], b: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    # Written out: a sum over an axis of three takes several times as long.
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
