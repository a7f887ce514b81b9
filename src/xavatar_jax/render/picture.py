"""A picture of a mesh."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ..geometry import face_normals
from ..meshing import Mesh
from .camera import Camera
from .light import (
    _SKY_RAYS,
    key_visibility,
    openness,
    shade,
    to_linear,
    to_srgb,
)
from .rays import Hits, RayScene

SHADINGS = ("color", "error", "normal", "flat")
_GROUND_NODES, _GROUND_RAYS = 64, 64


class _Surface(NamedTuple):
    """What is known of the points that a picture's rays hit."""

    albedo: Float[np.ndarray, "H 3"]
    normal: Float[np.ndarray, "H 3"]
    sky: Float[np.ndarray, "H"]
    key: Float[np.ndarray, "H"]


def render_mesh(
    mesh: Mesh,
    camera: Camera,
    size: int | tuple[int, int] = 512,
    *,
    shading: str = "color",
    base_color: tuple[float, float, float] = (0.80, 0.74, 0.69),
    background: tuple[float, float, float] | None = (0.965, 0.965, 0.97),
    ground: bool = False,
    ground_height: float | None = None,
    supersample: int = 2,
) -> UInt8[np.ndarray, "H W C"]:
    """Draw a mesh with soft light and shadow.

    Args:
        mesh: what to draw. Its own normals are used if it has them, its colours if it has any.
        camera: from where; see `frame_view` and `part_view`.
        size: width and height in pixels, or one number for both.
        shading: "color" (lit), "error" (lit gently, so that colours can be read off), "normal"
            (camera-frame normals: red right, green up, blue toward the camera) or "flat" (unlit).
        base_color: sRGB in 0 to 1, where the mesh has no colours.
        background: sRGB in 0 to 1, or None for a transparent one.
        ground: draw the mesh's soft shadow on a ground in the background's colour.
        ground_height: of the ground along the camera's up, metres. Default: the lowest vertex.
        supersample: rays along each side of a pixel.

    Returns:
        uint8 picture (H, W, 3), or (H, W, 4) with a transparent background.

    Raises:
        ValueError: if the shading is unknown or the size is below 1.
    """
    width, height = (size, size) if isinstance(size, int) else size
    if shading not in SHADINGS:
        raise ValueError(f"no shading {shading!r}: choose one of {', '.join(SHADINGS)}.")
    if min(width, height, supersample) < 1:
        raise ValueError(f"size and supersample must be 1 or more, found {size}, {supersample}.")
    scene = RayScene(mesh)
    canvas = np.empty((height, width, 4), dtype=np.float32)
    canvas[..., :3] = 0.0 if background is None else to_linear(np.asarray(background))
    canvas[..., 3] = background is not None
    if ground:
        lowest = float((mesh.vertices @ camera.up).min())
        level = lowest if ground_height is None else ground_height
        shadow = _ground_shadow(mesh, scene, camera, (width, height), level)
        canvas *= (1.0 - shadow)[..., None]
        canvas[..., 3] += shadow
    rows, columns = _covered(mesh, camera, width, height)
    rays = camera.rays(width * supersample, height * supersample, rows, columns, supersample)
    hits = scene.first_hits(camera.position, rays.reshape(-1, 3))
    if len(hits.ray):
        directions = rays.reshape(-1, 3)[hits.ray]
        layer = np.zeros((*rays.shape[:2], 4), dtype=np.float32)
        flat = layer.reshape(-1, 4)
        flat[hits.ray, :3] = _draw(mesh, scene, camera, directions, hits, shading, base_color)
        flat[hits.ray, 3] = 1.0
        # Clipped before the average, or a highlight's edge would stay jagged.
        layer = _pixel_means(np.clip(layer, 0.0, 1.0), supersample)
        canvas[rows, columns] = layer + (1.0 - layer[..., 3:]) * canvas[rows, columns]
    return _developed(canvas, background is None)


def _covered(mesh: Mesh, camera: Camera, width: int, height: int) -> tuple[slice, slice]:
    """Rows and columns that the mesh can appear in."""
    pixels = camera.project(mesh.vertices, width, height)
    if (pixels[:, 2] <= 1e-6).any():
        return slice(0, height), slice(0, width)
    low = np.floor(pixels[:, :2].min(axis=0) - 1).astype(int)
    high = np.ceil(pixels[:, :2].max(axis=0) + 1).astype(int)
    low = np.clip(low, 0, (width, height))
    high = np.clip(high, low, (width, height))
    return slice(low[1], high[1]), slice(low[0], high[0])


def _draw(
    mesh: Mesh,
    scene: RayScene,
    camera: Camera,
    directions: Float[np.ndarray, "H 3"],
    hits: Hits,
    shading: str,
    base_color: tuple[float, float, float],
) -> Float[np.ndarray, "H 3"]:
    """Linear colours of the hits."""
    toward_eye = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    surface = _interpolated(mesh, scene, camera, toward_eye, hits, shading, base_color)
    if shading == "flat":
        return surface.albedo
    if shading == "normal":
        in_camera = surface.normal @ (camera.rotation * [[1.0], [-1.0], [-1.0]]).T
        return to_linear(0.5 + 0.5 * in_camera)
    lit = shade(surface.albedo, surface.normal, toward_eye, surface.sky, surface.key, camera)
    return 0.55 * surface.albedo + 0.45 * lit if shading == "error" else lit


def _interpolated(
    mesh: Mesh,
    scene: RayScene,
    camera: Camera,
    toward_eye: Float[np.ndarray, "H 3"],
    hits: Hits,
    shading: str,
    base_color: tuple[float, float, float],
) -> _Surface:
    """Colours, normals and visibilities at the hits, from the corners of the faces hit."""
    corners = mesh.faces[hits.face]
    weights = hits.weights[..., None].astype(np.float32)

    def at_hits(per_vertex: np.ndarray) -> np.ndarray:
        return (per_vertex.astype(np.float32)[corners] * weights).sum(axis=1)

    if mesh.colors is None:
        albedo = np.broadcast_to(to_linear(np.asarray(base_color)), toward_eye.shape)
        albedo = albedo.astype(np.float32)
    else:
        albedo = at_hits(to_linear(mesh.colors[:, :3] / 255.0))
    with_normals = mesh if mesh.normals is not None else mesh.compute_normals()
    normals = np.asarray(with_normals.normals, dtype=np.float32)
    normal = at_hits(normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    flat = face_normals(mesh.vertices, mesh.faces[hits.face]).astype(np.float32)
    normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), flat)
    # What is seen faces the eye: the inside of an open mesh is lit like the outside.
    normal = np.where((flat * toward_eye).sum(axis=1, keepdims=True) < 0, -normal, normal)
    if shading in ("flat", "normal"):
        free = np.ones(len(normal), dtype=np.float32)
        return _Surface(albedo, normal, free, free)
    # Visibility is smooth: at the vertices of the faces seen it costs less and shows no noise.
    used = np.unique(corners)
    extent = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    lift = 2e-3 * extent
    sky, key = np.ones(mesh.num_vertices), np.ones(mesh.num_vertices)
    points, outward = mesh.vertices[used].astype(np.float32), normals[used]
    sky[used] = openness(scene, points, outward, count=_SKY_RAYS, reach=0.25 * extent, lift=lift)
    key[used] = key_visibility(scene, points, outward, camera, reach=extent, lift=lift)
    return _Surface(albedo, normal, at_hits(sky[:, None])[:, 0], at_hits(key[:, None])[:, 0])


def _ground_shadow(
    mesh: Mesh,
    scene: RayScene,
    camera: Camera,
    size: tuple[int, int],
    height: float,
) -> Float[np.ndarray, "H W"]:
    """How dark the mesh makes the ground in each pixel, 0 to 1; `size` is width and height."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    up = camera.up
    across = np.linalg.svd(up[None])[2][1:]
    flat = mesh.vertices @ across.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = 0.3 * float((high - low).max())
    low, high = low - room, high + room
    steps = [np.linspace(low[i], high[i], _GROUND_NODES) for i in range(2)]
    nodes = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    extent = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    dark = 1.0 - openness(
        scene,
        nodes @ across + height * up,
        np.broadcast_to(up, (len(nodes), 3)),
        count=_GROUND_RAYS,
        reach=0.4 * extent,
        lift=1e-3 * extent,
    )
    grid = gaussian_filter(dark.reshape(_GROUND_NODES, _GROUND_NODES), 1.0)
    # Fade out towards the patch's border, so that no border shows.
    fade = np.clip(4.0 * np.linspace(0, 1, _GROUND_NODES), 0.0, 1.0)
    fade = np.minimum(fade, fade[::-1])
    grid *= fade[:, None] * fade
    below = float(camera.position @ up) - height
    rays = camera.rays(*size)
    slope = rays @ -up.astype(np.float32)
    # From below, the ground hides nothing.
    hit = (slope > 1e-6) & (below > 0)
    distance = np.where(hit, below / np.where(hit, slope, 1.0), 0.0)
    place = (camera.position @ across.T) + distance[..., None] * (rays @ across.T)
    index = (place - low) / (high - low) * (_GROUND_NODES - 1)
    found = map_coordinates(grid, index.reshape(-1, 2).T, order=1, mode="constant")
    return np.where(hit, 0.75 * found.reshape(hit.shape), 0.0).astype(np.float32)


def _pixel_means(layer: Float[np.ndarray, "H W 4"], supersample: int) -> Float[np.ndarray, "h w 4"]:
    """Average the rays of each pixel."""
    total = np.zeros_like(layer[::supersample, ::supersample])
    for row in range(supersample):
        for column in range(supersample):
            total += layer[row::supersample, column::supersample]
    return total / supersample**2


def _developed(canvas: Float[np.ndarray, "H W 4"], transparent: bool) -> UInt8[np.ndarray, "H W C"]:
    """Linear light with colours multiplied by alpha, to sRGB."""
    color, alpha = canvas[..., :3], canvas[..., 3:]
    if transparent:
        color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    pixels = to_srgb(color)
    if transparent:
        pixels = np.concatenate([pixels, np.clip(alpha, 0.0, 1.0)], axis=-1)
    return np.round(pixels * 255.0).astype(np.uint8)
