"""Pictures and animations to files."""

import os
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8

from ..files import atomic_path


def save_png(path: str | os.PathLike[str], picture: np.ndarray) -> None:
    """Write a picture (H, W, 3 or 4) as PNG, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if the picture is not uint8 with 3 or 4 channels.
    """
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(_checked(picture)).save(temporary, format="PNG", optimize=True)


def save_webp_animation(
    frames: Iterable[np.ndarray],
    path: str | os.PathLike[str],
    fps: float | int = 15.0,
    *,
    quality: int = 80,
) -> None:
    """Write frames of one size as an endless WebP animation, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if there are no frames, they differ in shape, or `fps` is not positive or above
            500.
    """
    _save_animation(frames, path, fps, "WEBP", quality=quality, method=2)


def save_gif_animation(
    frames: Iterable[np.ndarray], path: str | os.PathLike[str], fps: float | int = 15.0
) -> None:
    """Write frames of one size as an endless GIF, whole or not at all.

    GIF has 256 colours and counts in hundredths of a second: WebP is smaller and better.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if there are no frames, they differ in shape, or `fps` is not positive or above
            50.
    """
    _save_animation(frames, path, fps, "GIF")


def _save_animation(
    frames: Iterable[np.ndarray],
    path: str | os.PathLike[str],
    fps: float,
    format: str,
    **options: int,
) -> None:
    from PIL import Image

    if not fps > 0:
        raise ValueError(f"fps must be positive, found {fps}.")
    unit = 10 if format == "GIF" else 1
    if fps > 500 / unit:
        raise ValueError(
            f"{fps:g} frames a second are more than a {format} can hold: {500 // unit} at most."
        )
    images = [_checked(frame) for frame in frames]
    if not images:
        raise ValueError("an animation needs at least one frame.")
    if len({image.shape for image in images}) > 1:
        raise ValueError(f"frames differ in shape: {sorted({i.shape for i in images})}.")
    # Whole units of the format, whose sum keeps time.
    ends = unit * np.round(np.arange(len(images) + 1) * (1000 / fps / unit)).astype(int)
    first, *rest = [Image.fromarray(image) for image in images]
    with atomic_path(path) as temporary:
        first.save(
            temporary,
            format=format,
            save_all=True,
            append_images=rest,
            duration=np.diff(ends).tolist(),
            loop=0,
            **options,
        )


def _checked(picture: np.ndarray) -> UInt8[np.ndarray, "H W C"]:
    """The picture, if it is one."""
    array = np.ascontiguousarray(picture)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] not in (3, 4):
        raise ValueError(
            f"a picture must be uint8 of shape (H, W, 3) or (H, W, 4), found {array.dtype} "
            f"{array.shape}."
        )
    return array
