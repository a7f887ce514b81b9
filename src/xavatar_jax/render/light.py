"""Light on a surface: sky, key, fill and rim, with soft shadows."""

import numpy as np
from jaxtyping import Float

from .camera import Camera
from .rays import RayScene, hemisphere_directions, tangent_frames

# Directions to the lights in the frame (right, up, toward the camera), and linear colours.
_KEY, _KEY_COLOR = np.array([-0.55, 0.75, 0.75]), np.array([1.95, 1.88, 1.78])
_FILL, _FILL_COLOR = np.array([0.9, 0.15, 0.55]), np.array([0.26, 0.29, 0.34])
_RIM, _RIM_COLOR = np.array([0.5, 0.55, -0.9]), np.array([0.42, 0.44, 0.48])
_SKY_COLOR, _FLOOR_COLOR = np.array([0.62, 0.64, 0.68]), np.array([0.36, 0.34, 0.32])
SKY_RAYS, _KEY_RAYS = 16, 6


def light_frame(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Columns right, up and toward the camera, upright whatever the camera's tilt."""
    toward = -camera.rotation[2]
    level = toward - (toward @ camera.up) * camera.up
    if np.linalg.norm(level) < 1e-3:
        level = -camera.rotation[1] + (camera.rotation[1] @ camera.up) * camera.up
    level /= np.linalg.norm(level)
    return np.stack([np.cross(camera.up, level), camera.up, level], axis=1)


def openness(
    scene: RayScene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    *,
    count: int,
    reach: float,
    lift: float,
) -> Float[np.ndarray, "N"]:
    """Cosine-weighted part of the sky over each point that the mesh leaves free, 0 to 1.

    Rays start `lift` metres above the surface and count as blocked within `reach` metres.
    """
    # Turned differently at each point, so that few rays make grain and not stripes.
    turn = np.arange(len(points)) * (np.pi * (3.0 - np.sqrt(5.0)))
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    frames = tangent_frames(normals)
    tangent, bitangent = frames[:, 0], frames[:, 1]
    frames[:, 0], frames[:, 1] = cos * tangent + sin * bitangent, cos * bitangent - sin * tangent
    directions = hemisphere_directions(count) @ frames
    return _free(scene, points + lift * normals, directions, reach)


def key_visibility(
    scene: RayScene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    camera: Camera,
    *,
    reach: float,
    lift: float,
) -> Float[np.ndarray, "N"]:
    """Part of the key light, a disc of some 15 degrees, that each point sees, 0 to 1."""
    key = light_frame(camera) @ (_KEY / np.linalg.norm(_KEY))
    disc = hemisphere_directions(_KEY_RAYS)
    disc = disc * [0.22, 0.22, 0.0] + [0.0, 0.0, 1.0]
    disc /= np.linalg.norm(disc, axis=1, keepdims=True)
    directions = disc @ tangent_frames(key[None])[0]
    facing = np.flatnonzero(normals @ key > -0.1)
    visible = np.zeros(len(points))
    bundle = np.broadcast_to(directions, (len(facing), *directions.shape))
    visible[facing] = _free(scene, points[facing] + lift * normals[facing], bundle, reach)
    return visible


def _free(
    scene: RayScene,
    origins: Float[np.ndarray, "N 3"],
    directions: Float[np.ndarray, "N K 3"],
    reach: float,
) -> Float[np.ndarray, "N"]:
    """Part of each origin's rays that meet nothing."""
    count = directions.shape[1]
    blocked = scene.occluded(np.repeat(origins, count, axis=0), directions.reshape(-1, 3), reach)
    return 1.0 - blocked.reshape(-1, count).mean(axis=1)


def shade(
    albedo: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    toward_eye: Float[np.ndarray, "N 3"],
    sky: Float[np.ndarray, "N"],
    key: Float[np.ndarray, "N"],
    camera: Camera,
) -> Float[np.ndarray, "N 3"]:
    """Linear colour of lit points, from linear albedo, unit normals and visibilities."""
    frame = light_frame(camera)
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
    # Light wraps a little round skin and cloth.
    wrapped = np.maximum(normals @ key_way + 0.15, 0.0) / 1.15
    light += (wrapped * key)[:, None] * key_color
    light += (np.maximum(normals @ fill_way, 0.0) * sky)[:, None] * fill_color
    light += (np.maximum(normals @ rim_way, 0.0) ** 2 * sky)[:, None] * rim_color
    half = toward_eye + key_way
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    gloss = np.maximum((normals * half).sum(axis=1), 0.0)
    for _ in range(5):
        gloss = gloss * gloss
    return 0.5 * albedo * light + 0.06 * (gloss * key)[:, None]


def to_linear(color: np.ndarray) -> np.ndarray:
    """sRGB in 0 to 1 to linear light."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def to_srgb(color: np.ndarray) -> np.ndarray:
    """Linear light to sRGB in 0 to 1, clipped."""
    color = np.clip(color, 0.0, 1.0)
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
