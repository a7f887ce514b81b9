"""A picture of a mesh."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..meshing import Mesh
from .camera import Camera
from .ground import ground_shadow
from .light import shade, to_linear, to_srgb
from .rays import Hits
from .sheet import BACKGROUND
from .subject import Points, Subject

SHADINGS = ("color", "error", "normal", "flat")
BASE_COLOR = (0.80, 0.74, 0.69)
SKIN_COLOR = (0.80, 0.66, 0.57)
"""Of an avatar without colours of its own, sRGB."""
TRUTH_COLOR = (0.72, 0.74, 0.78)
"""Of ground truth beside it, sRGB."""
# Neighbouring pixels that differ by more than this get more rays: normals, linear albedo, and
# depth as a part of the mesh's extent.
_EDGES = (0.35, 0.03, 0.015)


def render_mesh(
    mesh: Mesh,
    camera: Camera,
    size: int | tuple[int, int] = 512,
    *,
    shading: str = "color",
    base_color: tuple[float, float, float] = BASE_COLOR,
    background: tuple[float, float, float] | None = BACKGROUND,
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
        supersample: rays along each side of a pixel at edges, of outlines, shapes and colours.

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
    return draw_subject(
        Subject(mesh, base_color),
        camera,
        (width, height),
        shading=shading,
        background=background,
        ground=ground,
        ground_height=ground_height,
        supersample=supersample,
    )


def draw_subject(
    subject: Subject,
    camera: Camera,
    size: tuple[int, int],
    *,
    shading: str,
    background: tuple[float, float, float] | None,
    ground: bool,
    ground_height: float | None,
    supersample: int,
) -> UInt8[np.ndarray, "H W C"]:
    """`render_mesh` for a mesh that is ready, of which more than one picture is made."""
    width, height = size
    canvas = np.empty((height, width, 4), dtype=np.float32)
    canvas[..., :3] = 0.0 if background is None else to_linear(np.asarray(background))
    canvas[..., 3] = background is not None
    if ground:
        lowest = float((subject.mesh.vertices @ camera.up).min())
        level = lowest if ground_height is None else ground_height
        shadow = ground_shadow(subject, camera, size, level)
        canvas *= (1.0 - shadow)[..., None]
        canvas[..., 3] += shadow
    rows, columns = _covered(subject.mesh, camera, width, height)
    samples = _cast(subject, camera, size, rows, columns, supersample)
    if len(samples.pixel):
        # Clipped before the average, or a highlight's edge would stay jagged.
        colors = np.clip(_colors(subject, camera, samples, shading), 0.0, 1.0)
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
    """Rays that hit, the pixel of the window that each belongs to, and its share of the pixel."""

    hits: Hits
    toward_eye: Float[np.ndarray, "H 3"]
    points: Points
    pixel: Int[np.ndarray, "H"]
    share: Float[np.ndarray, "H"]


def _cast(
    subject: Subject,
    camera: Camera,
    size: tuple[int, int],
    rows: slice,
    columns: slice,
    supersample: int,
) -> _Samples:
    """A ray through the centre of each pixel of the window, more where neighbours differ."""
    rays = camera.rays(*size, rows, columns)
    shape = rays.shape[:2]
    first = _sampled(subject, camera, rays.reshape(-1, 3), np.arange(shape[0] * shape[1]), 1)
    if supersample == 1 or not len(first.pixel):
        return first
    fine = _edges(subject, camera, first, shape).reshape(-1)
    pixel = np.flatnonzero(fine)
    width, height = size
    all_rays = camera.rays(width * supersample, height * supersample, rows, columns, supersample)
    blocks = all_rays.reshape(shape[0], supersample, shape[1], supersample, 3).swapaxes(1, 2)
    chosen = blocks.reshape(-1, supersample**2, 3)[pixel].reshape(-1, 3)
    more = _sampled(subject, camera, chosen, np.repeat(pixel, supersample**2), supersample**2)
    kept = ~fine[first.pixel]
    return _joined(first, kept, more)


def _sampled(
    subject: Subject,
    camera: Camera,
    rays: Float[np.ndarray, "N 3"],
    pixels: Int[np.ndarray, "N"],
    per_pixel: int,
) -> _Samples:
    hits = subject.scene.first_hits(camera.position, rays)
    toward_eye = -rays[hits.ray]
    toward_eye /= np.linalg.norm(toward_eye, axis=1, keepdims=True)
    share = np.full(len(hits.ray), 1.0 / per_pixel, dtype=np.float32)
    return _Samples(hits, toward_eye, subject.points(hits, toward_eye), pixels[hits.ray], share)


def _joined(first: _Samples, kept: Bool[np.ndarray, "H"], more: _Samples) -> _Samples:
    def both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.concatenate([a[kept], b])

    return _Samples(
        Hits(*(both(a, b) for a, b in zip(first.hits, more.hits, strict=True))),
        both(first.toward_eye, more.toward_eye),
        Points(*(both(a, b) for a, b in zip(first.points, more.points, strict=True))),
        both(first.pixel, more.pixel),
        both(first.share, more.share),
    )


def _edges(
    subject: Subject, camera: Camera, first: _Samples, shape: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Pixels that differ from a neighbour: in being hit, in direction, colour or depth."""
    normals, albedo, depth = _EDGES
    corner = subject.mesh.vertices[subject.mesh.faces[first.hits.face, 0]]
    away = (corner - camera.position) @ camera.rotation[2] / (depth * subject.extent)
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
    subject: Subject, camera: Camera, samples: _Samples, shading: str
) -> Float[np.ndarray, "H 3"]:
    """Linear colours of the samples."""
    albedo, normal = samples.points
    if shading == "flat":
        return albedo
    if shading == "normal":
        in_camera = normal @ (camera.rotation * [[1.0], [-1.0], [-1.0]]).T
        return to_linear(0.5 + 0.5 * in_camera)
    sky, key = subject.visibilities(samples.hits, camera)
    lit = shade(albedo, normal, samples.toward_eye, sky, key, camera)
    return 0.55 * albedo + 0.45 * lit if shading == "error" else lit


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


def _developed(canvas: Float[np.ndarray, "H W 4"], transparent: bool) -> UInt8[np.ndarray, "H W C"]:
    """Linear light with colours multiplied by alpha, to sRGB."""
    color, alpha = canvas[..., :3], canvas[..., 3:]
    if transparent:
        color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    pixels = to_srgb(color)
    if transparent:
        pixels = np.concatenate([pixels, np.clip(alpha, 0.0, 1.0)], axis=-1)
    return np.round(pixels * 255.0).astype(np.uint8)
