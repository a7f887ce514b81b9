"""Pictures of meshes: one, several views of one, or a sequence."""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..meshing import Mesh
from .camera import Camera, Vector, orbit_views
from .images import BACKGROUND
from .raycast import Hits, face_tuples
from .shading import PreparedMesh, SurfacePoints, ground_shadow, shade, to_linear, to_srgb

SHADINGS = ("color", "error", "normal", "flat")
BASE_COLOR = (0.80, 0.74, 0.69)
SKIN_COLOR = (0.80, 0.66, 0.57)
"""sRGB colour of an avatar that has no colours of its own."""
TRUTH_COLOR = (0.72, 0.74, 0.78)
"""sRGB colour of ground truth."""
# Neighbouring pixels that differ by more than this get more rays: normals, linear albedo, and
# depth as a fraction of the mesh's extent.
_EDGES = (0.35, 0.03, 0.015)
# Pictures of a sequence drawn at a time.
_THREADS = 2

Size = int | tuple[int, int]
Color = tuple[float, float, float]


class _Style(NamedTuple):
    """Options of a picture: see `render_mesh`."""

    shading: str = "color"
    base_color: Color = BASE_COLOR
    background: Color | None = BACKGROUND
    ground: bool = False
    ground_height: float | None = None
    supersample: int = 2


def render_mesh(
    mesh: Mesh,
    camera: Camera,
    size: Size = 512,
    *,
    shading: str = "color",
    base_color: Color = BASE_COLOR,
    background: Color | None = BACKGROUND,
    ground: bool = False,
    ground_height: float | None = None,
    supersample: int = 2,
) -> UInt8[np.ndarray, "H W C"]:
    """Draw a mesh with soft light and shadow.

    Args:
        mesh: what to draw; its own normals and colours are used if it has them.
        camera: from where; see `frame_view` and `part_view`.
        size: width and height in pixels, or one number for both.
        shading: "color" (lit), "error" (lit gently, so that colours can be read off), "normal"
            (camera-frame normals: red right, green up, blue toward the camera) or "flat" (unlit).
        base_color: sRGB in 0 to 1, used if the mesh has no colours.
        background: sRGB in 0 to 1, or None for a transparent one.
        ground: draw the mesh's soft shadow on a ground in the background's colour.
        ground_height: of the ground along the camera's up, metres. Default: the lowest vertex.
        supersample: rays along each side of a pixel at edges of outlines, shapes and colours.

    Returns:
        uint8 picture (H, W, 3), or (H, W, 4) with a transparent background.

    Raises:
        ValueError: if the shading is unknown or the size is below 1.
    """
    style = _Style(shading, base_color, background, ground, ground_height, supersample)
    shape = _checked(size, style)
    return _draw(PreparedMesh(mesh, base_color), camera, shape, style)


def render_views(
    mesh: Mesh,
    cameras: Sequence[Camera],
    size: Size | list[Size] = 512,
    *,
    verbose: bool = False,
    **options,
) -> list[UInt8[np.ndarray, "H W C"]]:
    """Draw a mesh from several cameras; what the pictures share is computed once.

    `size` is one for all pictures, or a list with one for each. Other options are those of
    `render_mesh`; `verbose` shows a progress bar.

    Raises:
        ValueError: if the shading is unknown, a size is below 1, or there is another number of
            sizes than of cameras.
    """
    from tqdm import tqdm

    style = _Style(**options)
    sizes = size if isinstance(size, list) else [size] * len(cameras)
    shapes = [_checked(each, style) for each in sizes]
    prepared = PreparedMesh(mesh, style.base_color)
    views = zip(tqdm(cameras, "pictures", disable=not verbose), shapes, strict=True)
    return [_draw(prepared, camera, shape, style) for camera, shape in views]


def render_sequence(
    meshes: Iterable[Mesh], camera: Camera, size: Size = 512, **options
) -> Iterator[UInt8[np.ndarray, "H W C"]]:
    """Draw meshes one after another from one camera, each as `render_mesh` draws it.

    Faster than one call a mesh, above all if they share their faces. A few meshes are read ahead.
    Options are those of `render_mesh`.

    Raises:
        ValueError: if the shading is unknown or the size is below 1.
    """
    style = _Style(**options)
    shape = _checked(size, style)

    def draw(mesh: Mesh, tuples: np.ndarray | None) -> UInt8[np.ndarray, "H W C"]:
        return _draw(PreparedMesh(mesh, style.base_color, tuples), camera, shape, style)

    faces = tuples = None
    waiting: deque[Future[np.ndarray]] = deque()
    with ThreadPoolExecutor(_THREADS) as pool:
        for mesh in meshes:
            if faces is None or not np.array_equal(mesh.faces, faces):
                faces, tuples = mesh.faces, face_tuples(mesh.faces)
            waiting.append(pool.submit(draw, mesh, tuples))
            if len(waiting) > _THREADS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def turntable(
    mesh: Mesh,
    count: int = 36,
    size: Size = 512,
    *,
    shading: str = "color",
    base_color: Color = BASE_COLOR,
    background: Color | None = BACKGROUND,
    ground: bool = True,
    up: Vector = (0.0, 1.0, 0.0),
    forward: Vector = (0.0, 0.0, 1.0),
    elevation: float = math.radians(8.0),
    supersample: int = 2,
    verbose: bool = False,
) -> list[UInt8[np.ndarray, "H W C"]]:
    """Draw a mesh `count` times on a full turn, from the front at first, all at one scale.

    The left side of the mesh appears first; the light stays with the camera.
    `save_webp_animation` writes the pictures to a file.

    Args:
        mesh: what to draw.
        count: number of pictures.
        size: width and height in pixels, or one number for both.
        shading, base_color, background, supersample: as for `render_mesh`.
        ground: draw the mesh's soft shadow on a ground.
        up: the world's up direction.
        forward: the direction that the person faces.
        elevation: how far above the horizon the camera stands, radians.
        verbose: show a progress bar.

    Raises:
        ValueError: if the shading is unknown, or `count` or the size is below 1.
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, found {count}.")
    style = _Style(shading, base_color, background, ground, None, supersample)
    width, height = _checked(size, style)
    cameras = orbit_views(
        mesh.vertices, count, aspect=width / height, up=up, forward=forward, elevation=elevation
    )
    return render_views(mesh, cameras, size, verbose=verbose, **style._asdict())


def _checked(size: Size, style: _Style) -> tuple[int, int]:
    """Width and height, if they and the options are valid."""
    width, height = (size, size) if isinstance(size, int) else size
    if style.shading not in SHADINGS:
        raise ValueError(f"no shading {style.shading!r}: choose one of {', '.join(SHADINGS)}.")
    if min(width, height, style.supersample) < 1:
        raise ValueError(
            f"size and supersample must be 1 or more, found {size}, {style.supersample}."
        )
    return width, height


def _draw(
    prepared: PreparedMesh, camera: Camera, size: tuple[int, int], style: _Style
) -> UInt8[np.ndarray, "H W C"]:
    width, height = size
    background = style.background
    canvas = np.empty((height, width, 4), dtype=np.float32)
    canvas[..., :3] = 0.0 if background is None else to_linear(np.asarray(background))
    canvas[..., 3] = background is not None
    if style.ground:
        level = style.ground_height
        if level is None:
            level = float((prepared.mesh.vertices @ camera.up).min())
        shadow = ground_shadow(prepared, camera, size, level)
        canvas *= (1.0 - shadow)[..., None]
        canvas[..., 3] += shadow
    rows, columns = _covered(prepared.mesh, camera, width, height)
    samples = _cast(prepared, camera, size, rows, columns, style.supersample)
    if len(samples.pixel):
        # Clipped before the average, or the edges of highlights would stay jagged.
        colors = np.clip(_colors(prepared, camera, samples, style.shading), 0.0, 1.0)
        window = canvas[rows, columns]
        count = window.shape[0] * window.shape[1]
        layer = np.stack(
            [
                np.bincount(samples.pixel, samples.share * channel, minlength=count)
                for channel in (*colors.T, np.ones(len(colors), dtype=np.float32))
            ],
            axis=-1,
        ).reshape(window.shape)
        canvas[rows, columns] = layer + (1.0 - layer[..., 3:]) * window
    return _developed(canvas, background is None)


class _Samples(NamedTuple):
    """Rays that hit, with the pixel of the window that each belongs to and its share of it."""

    hits: Hits
    toward_eye: Float[np.ndarray, "H 3"]
    points: SurfacePoints
    pixel: Int[np.ndarray, "H"]
    share: Float[np.ndarray, "H"]


def _cast(
    prepared: PreparedMesh,
    camera: Camera,
    size: tuple[int, int],
    rows: slice,
    columns: slice,
    supersample: int,
) -> _Samples:
    """Cast a ray through the centre of each pixel, and more where neighbours differ."""
    rays = camera.rays(*size, rows, columns)
    shape = rays.shape[:2]
    first = _sampled(prepared, camera, rays.reshape(-1, 3), np.arange(shape[0] * shape[1]), 1)
    if supersample == 1 or not len(first.pixel):
        return first
    fine = _edges(prepared, camera, first, shape).reshape(-1)
    pixel = np.flatnonzero(fine)
    width, height = size
    all_rays = camera.rays(width * supersample, height * supersample, rows, columns, supersample)
    blocks = all_rays.reshape(shape[0], supersample, shape[1], supersample, 3).swapaxes(1, 2)
    chosen = blocks.reshape(-1, supersample**2, 3)[pixel].reshape(-1, 3)
    more = _sampled(prepared, camera, chosen, np.repeat(pixel, supersample**2), supersample**2)
    kept = ~fine[first.pixel]
    return _joined(first, kept, more)


def _sampled(
    prepared: PreparedMesh,
    camera: Camera,
    rays: Float[np.ndarray, "N 3"],
    pixels: Int[np.ndarray, "N"],
    per_pixel: int,
) -> _Samples:
    hits = prepared.scene.first_hits(camera.position, rays)
    toward_eye = -rays[hits.ray]
    toward_eye /= np.linalg.norm(toward_eye, axis=1, keepdims=True)
    share = np.full(len(hits.ray), 1.0 / per_pixel, dtype=np.float32)
    return _Samples(hits, toward_eye, prepared.at(hits, toward_eye), pixels[hits.ray], share)


def _joined(first: _Samples, kept: Bool[np.ndarray, "H"], more: _Samples) -> _Samples:
    def both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.concatenate([a[kept], b])

    return _Samples(
        Hits(*(both(a, b) for a, b in zip(first.hits, more.hits, strict=True))),
        both(first.toward_eye, more.toward_eye),
        SurfacePoints(*(both(a, b) for a, b in zip(first.points, more.points, strict=True))),
        both(first.pixel, more.pixel),
        both(first.share, more.share),
    )


def _edges(
    prepared: PreparedMesh, camera: Camera, first: _Samples, shape: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Pixels that differ from a neighbour in being hit, direction, colour or depth."""
    normals, albedo, depth = _EDGES
    corner = prepared.mesh.vertices[prepared.mesh.faces[first.hits.face, 0]]
    away = (corner - camera.position) @ camera.rotation[2] / (depth * prepared.extent)
    features = np.full((shape[0] * shape[1], 7), 1e6, dtype=np.float32)
    features[first.pixel, :3] = first.points.normal / normals
    features[first.pixel, 3:6] = first.points.albedo / albedo
    features[first.pixel, 6] = away
    features = features.reshape(*shape, 7)
    found = np.zeros(shape, dtype=bool)
    for axis in (0, 1):
        differs = np.zeros(np.diff(features[..., 0], axis=axis).shape, dtype=bool)
        for k in range(7):
            differs |= np.abs(np.diff(features[..., k], axis=axis)) > 1.0
        ahead = [slice(None), slice(None)]
        behind = list(ahead)
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        found[tuple(ahead)] |= differs
        found[tuple(behind)] |= differs
    return found


def _colors(
    prepared: PreparedMesh, camera: Camera, samples: _Samples, shading: str
) -> Float[np.ndarray, "H 3"]:
    """Linear colours of the samples."""
    albedo, normal = samples.points
    if shading == "flat":
        return albedo
    if shading == "normal":
        in_camera = normal @ (camera.rotation * [[1.0], [-1.0], [-1.0]]).T
        return to_linear(0.5 + 0.5 * in_camera)
    sky, key = prepared.visibilities(samples.hits, camera)
    lit = shade(samples.points, samples.toward_eye, sky, key, camera)
    return 0.55 * albedo + 0.45 * lit if shading == "error" else lit


def _covered(mesh: Mesh, camera: Camera, width: int, height: int) -> tuple[slice, slice]:
    """Rows and columns of the window that the mesh can appear in."""
    pixels = camera.project(mesh.vertices, width, height)
    if (pixels[:, 2] <= 1e-6).any():
        return slice(0, height), slice(0, width)
    low = np.floor(pixels[:, :2].min(axis=0) - 1).astype(int)
    high = np.ceil(pixels[:, :2].max(axis=0) + 1).astype(int)
    low = np.clip(low, 0, (width, height))
    high = np.clip(high, low, (width, height))
    return slice(low[1], high[1]), slice(low[0], high[0])


def _developed(canvas: Float[np.ndarray, "H W 4"], transparent: bool) -> UInt8[np.ndarray, "H W C"]:
    """Convert linear light, multiplied by alpha, to sRGB."""
    color, alpha = canvas[..., :3], canvas[..., 3:]
    if transparent:
        color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    pixels = to_srgb(color)
    if transparent:
        pixels = np.concatenate([pixels, np.clip(alpha, 0.0, 1.0)], axis=-1)
    return np.round(pixels * 255.0).astype(np.uint8)
