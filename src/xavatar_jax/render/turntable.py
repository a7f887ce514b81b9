"""Pictures from all sides."""

import math

import numpy as np
from jaxtyping import UInt8

from ..meshing import Mesh
from .camera import Camera, Vector, orbit_views
from .picture import BACKGROUND, BASE_COLOR, SHADINGS, draw_subject
from .subject import Subject


def turntable(
    mesh: Mesh,
    count: int = 36,
    size: int | tuple[int, int] = 512,
    *,
    shading: str = "color",
    base_color: tuple[float, float, float] = BASE_COLOR,
    background: tuple[float, float, float] | None = BACKGROUND,
    ground: bool = True,
    up: Vector = (0.0, 1.0, 0.0),
    forward: Vector = (0.0, 0.0, 1.0),
    elevation: float = math.radians(8.0),
    supersample: int = 2,
    verbose: bool = False,
) -> list[UInt8[np.ndarray, "H W C"]]:
    """`count` pictures of a mesh on a full turn, the first from the front, all at one scale.

    The mesh turns with its left side coming first; the light stays with the camera. What the
    pictures share (rays, openness to the sky) is computed once. `save_webp_animation` writes them.

    Args:
        mesh: what to draw.
        count: pictures.
        size: width and height in pixels, or one number for both.
        shading, base_color, background, supersample: as for `render_mesh`.
        ground: draw the mesh's soft shadow on a ground.
        up: the world's up direction.
        forward: the direction that the person faces.
        elevation: how far above the horizon the camera stands, radians.
        verbose: show a bar.

    Raises:
        ValueError: if the shading is unknown, or `count` or the size is below 1.
    """
    from tqdm import tqdm

    width, height = (size, size) if isinstance(size, int) else size
    if shading not in SHADINGS:
        raise ValueError(f"no shading {shading!r}: choose one of {', '.join(SHADINGS)}.")
    if min(count, width, height, supersample) < 1:
        raise ValueError(
            f"count, size and supersample must be 1 or more, found {count}, {size}, {supersample}."
        )
    cameras: list[Camera] = orbit_views(
        mesh.vertices, count, aspect=width / height, up=up, forward=forward, elevation=elevation
    )
    subject = Subject(mesh, base_color)
    return [
        draw_subject(
            subject,
            camera,
            (width, height),
            shading=shading,
            background=background,
            ground=ground,
            ground_height=None,
            supersample=supersample,
        )
        for camera in tqdm(cameras, "turntable", disable=not verbose, unit="picture")
    ]
