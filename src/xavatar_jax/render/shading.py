"""Light on a mesh and on the ground below it: sky, key, fill and rim light, with soft shadows."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..geometry import corner_matrix, vertex_normals
from ..meshing import Mesh
from .camera import Camera
from .raycast import Hits, RayScene, hemisphere_directions, tangent_frames

# Directions to the lights in the frame (right, up, toward the camera), and linear colours.
_KEY, _KEY_COLOR = np.array([-0.55, 0.75, 0.75]), np.array([1.95, 1.88, 1.78])
_FILL, _FILL_COLOR = np.array([0.9, 0.15, 0.55]), np.array([0.26, 0.29, 0.34])
_RIM, _RIM_COLOR = np.array([0.5, 0.55, -0.9]), np.array([0.42, 0.44, 0.48])
_SKY_COLOR, _FLOOR_COLOR = np.array([0.62, 0.64, 0.68]), np.array([0.36, 0.34, 0.32])
_SKY_RAYS, _KEY_RAYS = 16, 6
# Visibility is sampled at no more vertices than `_MANY` plus one per `_RAYS_A_VERTEX` camera rays;
# averaging over neighbours fills in the rest.
_MANY, _RAYS_A_VERTEX = 8000, 20
_SMOOTHINGS = 3
# The ground's shadow: nodes along each side, rays per node, and how much the sky and the key light
# contribute to its darkness.
_NODES, _GROUND_RAYS = 72, 24
_SKY_SHARE, _KEY_SHARE = 0.85, 0.30


class SurfacePoints(NamedTuple):
    """Points on the surface: linear albedo, and unit normals that face the camera."""

    albedo: Float[np.ndarray, "H 3"]
    normal: Float[np.ndarray, "H 3"]


class PreparedMesh:
    """A mesh with what all its pictures share: ray scene, normals, colours, openness to the sky.

    Args:
        mesh: its own normals and colours are used if it has them.
        base_color: sRGB in 0 to 1, used if the mesh has no colours.
        tuples: `face_tuples` of the mesh, if available.
    """

    def __init__(
        self, mesh: Mesh, base_color: tuple[float, float, float], tuples: np.ndarray | None = None
    ) -> None:
        self.mesh = mesh
        self.scene = RayScene(mesh, tuples)
        normals = mesh.normals
        if normals is None:
            normals = vertex_normals(mesh.vertices, mesh.faces)
        self.extent = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
        self._points = mesh.vertices.astype(np.float32)
        self._base = to_linear(np.asarray(base_color)).astype(np.float32)
        self._channels = np.asarray(normals, dtype=np.float32)
        if mesh.colors is not None:
            albedo = to_linear(np.arange(256) / 255.0).astype(np.float32)[mesh.colors[:, :3]]
            self._channels = np.concatenate([self._channels, albedo], axis=1)
        self._sky = np.full(mesh.num_vertices, np.nan, dtype=np.float32)  # NaN: not sampled yet

    def at(self, hits: Hits, toward_eye: Float[np.ndarray, "H 3"]) -> SurfacePoints:
        """Colours and normals at the hits, interpolated over the faces."""
        found = self._interpolated(self._channels, hits)
        normal = found[:, :3]
        a, b, c = self.mesh.vertices[self.mesh.faces[hits.face].T]
        flat = np.cross(b - a, c - a).astype(np.float32)
        flat /= np.maximum(np.sqrt(_dot(flat, flat)), 1e-30)[:, None]
        length = np.sqrt(_dot(normal, normal))[:, None]
        normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), flat)
        # Normals face the camera: the inside of an open mesh is lit like the outside.
        normal = np.where(_dot(flat, toward_eye)[:, None] < 0, -normal, normal)
        albedo = np.broadcast_to(self._base, normal.shape) if found.shape[1] == 3 else found[:, 3:]
        return SurfacePoints(albedo, normal)

    def visibilities(
        self, hits: Hits, camera: Camera
    ) -> tuple[Float[np.ndarray, "H"], Float[np.ndarray, "H"]]:
        """Fractions of the sky and of the key light that the hits see, 0 to 1.

        Visibility varies smoothly, so it is sampled at vertices of the visible faces and averaged
        over neighbours, which also removes the noise of few rays.
        """
        seen = np.zeros(self.mesh.num_faces, dtype=bool)
        seen[hits.face] = True
        faces = self.mesh.faces[seen]
        marked = np.zeros(self.mesh.num_vertices, dtype=bool)
        marked[faces.reshape(-1)] = True
        used = np.flatnonzero(marked)
        every = 1 + len(used) // (_MANY + len(hits.ray) // _RAYS_A_VERTEX)
        chosen = used[used % every == 0]
        lift = 2e-3 * self.extent
        points, outward = self._points, self._channels[:, :3]
        new = chosen[np.isnan(self._sky[chosen])]
        if len(new):
            self._sky[new] = openness(
                self.scene, points[new], outward[new], _SKY_RAYS, 0.25 * self.extent, lift
            )
        both = np.full((self.mesh.num_vertices, 2), np.nan, dtype=np.float32)
        both[chosen, 0] = self._sky[chosen]
        both[chosen, 1] = key_visibility(
            self.scene, points[chosen], outward[chosen], camera, self.extent, lift
        )
        number = np.zeros(self.mesh.num_vertices, dtype=np.int32)
        number[used] = np.arange(len(used), dtype=np.int32)
        spread = np.ones((self.mesh.num_vertices, 2), dtype=np.float32)
        spread[used] = _smoothed(both[used], number[faces], _SMOOTHINGS)
        found = self._interpolated(spread, hits)
        return found[:, 0], found[:, 1]

    def _interpolated(
        self, per_vertex: Float[np.ndarray, "V C"], hits: Hits
    ) -> Float[np.ndarray, "H C"]:
        corners, weights = self.mesh.faces[hits.face], hits.weights.astype(np.float32)
        out = weights[:, :1] * per_vertex[corners[:, 0]]
        out += weights[:, 1:2] * per_vertex[corners[:, 1]]
        out += weights[:, 2:] * per_vertex[corners[:, 2]]
        return out


def openness(
    scene: RayScene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    count: int,
    reach: float,
    lift: float,
) -> Float[np.ndarray, "N"]:
    """Cosine-weighted fraction of the sky that each point sees, 0 to 1.

    `count` rays a point start `lift` metres above the surface and are blocked by anything within
    `reach` metres.
    """
    # Rotated by another angle at each point, so that few rays give grain instead of stripes.
    turn = np.arange(len(points)) * (np.pi * (3.0 - np.sqrt(5.0)))
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    frames = tangent_frames(normals)
    tangent, bitangent = frames[:, 0], frames[:, 1]
    frames[:, 0], frames[:, 1] = cos * tangent + sin * bitangent, cos * bitangent - sin * tangent
    return scene.unblocked(points + lift * normals, hemisphere_directions(count) @ frames, reach)


def key_visibility(
    scene: RayScene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    camera: Camera,
    reach: float,
    lift: float,
) -> Float[np.ndarray, "N"]:
    """Fraction of the key light, a disc of about 15 degrees, that each point sees, 0 to 1."""
    key = _light_frame(camera) @ (_KEY / np.linalg.norm(_KEY))
    disc = hemisphere_directions(_KEY_RAYS) * [0.22, 0.22, 0.0] + [0.0, 0.0, 1.0]
    disc /= np.linalg.norm(disc, axis=1, keepdims=True)
    directions = disc @ tangent_frames(key[None])[0]
    facing = np.flatnonzero(normals @ key > -0.1)
    visible = np.zeros(len(points))
    bundle = np.broadcast_to(directions, (len(facing), *directions.shape))
    visible[facing] = scene.unblocked(points[facing] + lift * normals[facing], bundle, reach)
    return visible


def shade(
    points: SurfacePoints,
    toward_eye: Float[np.ndarray, "H 3"],
    sky: Float[np.ndarray, "H"],
    key: Float[np.ndarray, "H"],
    camera: Camera,
) -> Float[np.ndarray, "H 3"]:
    """Linear colour of lit points, given how much of the sky and the key light they see."""
    albedo, normals = points
    frame = _light_frame(camera)
    dtype = normals.dtype
    key_color, fill_color, rim_color, sky_color, floor_color = (
        color.astype(dtype)
        for color in (_KEY_COLOR, _FILL_COLOR, _RIM_COLOR, _SKY_COLOR, _FLOOR_COLOR)
    )
    key_way, fill_way, rim_way = (
        (frame @ (way / np.linalg.norm(way))).astype(dtype) for way in (_KEY, _FILL, _RIM)
    )
    height = (0.5 + 0.5 * normals @ camera.up.astype(dtype))[:, None]
    light = sky[:, None] * (height * sky_color + (1 - height) * floor_color)
    # Light wraps around skin and cloth a little.
    wrapped = np.maximum(normals @ key_way + 0.15, 0.0) / 1.15
    light += (wrapped * key)[:, None] * key_color
    light += (np.maximum(normals @ fill_way, 0.0) * sky)[:, None] * fill_color
    light += (np.maximum(normals @ rim_way, 0.0) ** 2 * sky)[:, None] * rim_color
    half = toward_eye + key_way
    half /= np.sqrt(_dot(half, half))[:, None]
    gloss = np.maximum(_dot(normals, half), 0.0)
    for _ in range(5):
        gloss = gloss * gloss
    return 0.5 * albedo * light + 0.06 * (gloss * key)[:, None]


def ground_shadow(
    prepared: PreparedMesh, camera: Camera, size: tuple[int, int], height: float
) -> Float[np.ndarray, "H W"]:
    """How much the mesh darkens the ground in each pixel, 0 to 1.

    Args:
        prepared: the mesh that stands on the ground.
        camera: where it is seen from.
        size: width and height in pixels.
        height: of the ground along the camera's up, metres.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    up = camera.up
    across = np.linalg.svd(up[None])[2][1:]
    flat = prepared.mesh.vertices @ across.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = 0.35 * float((high - low).max())
    low, high = low - room, high + room
    steps = [np.linspace(low[i], high[i], _NODES) for i in range(2)]
    nodes = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    points = nodes @ across + height * up
    normals = np.broadcast_to(up, (len(nodes), 3))
    reach, lift = 0.4 * prepared.extent, 1e-3 * prepared.extent
    sky = openness(prepared.scene, points, normals, _GROUND_RAYS, reach, lift)
    key = key_visibility(prepared.scene, points, normals, camera, reach, lift)
    sky, key = (
        gaussian_filter(value.reshape(_NODES, _NODES), sigma)
        for value, sigma in ((sky, 1.0), (key, 1.6))
    )
    grid = 1.0 - (1.0 - _SKY_SHARE * (1.0 - sky)) * (1.0 - _KEY_SHARE * (1.0 - key))
    # Fade out towards the border of the grid, which would show otherwise.
    fade = np.clip(4.0 * np.linspace(0, 1, _NODES), 0.0, 1.0)
    fade = np.minimum(fade, fade[::-1])
    grid *= fade[:, None] * fade
    below = float(camera.position @ up) - height
    rays = camera.rays(*size)
    slope = rays @ -up.astype(np.float32)
    # From below, the ground hides nothing.
    hit = (slope > 1e-6) & (below > 0)
    shadow = np.zeros(hit.shape, dtype=np.float32)
    toward = rays[hit]
    distance = below / slope[hit]
    place = (camera.position @ across.T) + distance[:, None] * (toward @ across.T)
    index = (place - low) / (high - low) * (_NODES - 1)
    shadow[hit] = map_coordinates(grid, index.T, order=1, mode="constant")
    return shadow


def to_linear(color: np.ndarray) -> np.ndarray:
    """Convert sRGB in 0 to 1 to linear light."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def to_srgb(color: np.ndarray) -> np.ndarray:
    """Convert linear light to sRGB in 0 to 1, clipped."""
    color = np.clip(color, 0.0, 1.0)
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)


def _light_frame(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Columns right, up and toward the camera; upright whatever the camera's tilt."""
    toward = -camera.rotation[2]
    level = toward - (toward @ camera.up) * camera.up
    if np.linalg.norm(level) < 1e-3:
        level = -camera.rotation[1] + (camera.rotation[1] @ camera.up) * camera.up
    level /= np.linalg.norm(level)
    return np.stack([np.cross(camera.up, level), camera.up, level], axis=1)


def _smoothed(
    values: Float[np.ndarray, "V C"], faces: Int[np.ndarray, "F 3"], times: int
) -> Float[np.ndarray, "V C"]:
    """Average over the faces around each vertex, several times.

    NaN means unknown and is left out; the result is 1 where no neighbour is known.
    """
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
