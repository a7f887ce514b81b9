"""Arranging pictures with labels, and writing pictures and animations to files."""

import os
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import UInt8

from ..files import atomic_path

BACKGROUND = (0.965, 0.965, 0.97)
"""Background of pictures and sheets, sRGB."""
_TEXT_COLOR = (60, 62, 68)


def draw_text(
    picture: UInt8[np.ndarray, "H W 3"],
    text: str,
    at: tuple[int, int],
    size: int = 15,
    *,
    centred: bool = False,
) -> UInt8[np.ndarray, "H W 3"]:
    """Copy `picture` and write dark text with its upper left (or upper centre) at `at` = (x, y)."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    draw.text(
        at,
        text,
        fill=_TEXT_COLOR,
        font=ImageFont.load_default(size),
        anchor="ma" if centred else "la",
    )
    return np.asarray(image)


def grid_picture(
    rows: Sequence[Sequence[np.ndarray]],
    *,
    column_labels: Sequence[str] = (),
    row_labels: Sequence[str] = (),
    title: str = "",
    gap: int = 6,
    text_size: int = 16,
    background: tuple[float, float, float] = BACKGROUND,
) -> UInt8[np.ndarray, "H W 3"]:
    """Arrange pictures in rows, with labels above the columns and left of the rows.

    Pictures are uint8 (h, w, 3 or 4), centred in cells as high as the highest picture of the row
    and as wide as the widest of the column. Rows may differ in length.

    Raises:
        ValueError: if there are no pictures, or more labels than rows or columns.
    """
    count = max((len(row) for row in rows), default=0)
    if count == 0:
        raise ValueError("no pictures to arrange.")
    if len(column_labels) > count or len(row_labels) > len(rows):
        raise ValueError(
            f"{len(column_labels)} column and {len(row_labels)} row labels for {count} columns "
            f"and {len(rows)} rows."
        )
    heights = [max((p.shape[0] for p in row), default=0) for row in rows]
    widths = [
        max((row[j].shape[1] for row in rows if j < len(row)), default=0) for j in range(count)
    ]
    line = round(1.8 * text_size)
    left = gap + (round(0.62 * text_size * max(map(len, row_labels))) + gap if row_labels else 0)
    top = gap + (round(1.4 * line) if title else 0) + (line if column_labels else 0)
    shape = (top + sum(heights) + gap * len(rows), left + sum(widths) + gap * count, 3)
    sheet = np.empty(shape, dtype=np.uint8)
    sheet[:] = np.round(np.asarray(background) * 255.0)
    x0 = left + np.concatenate([[0], np.cumsum(np.asarray(widths) + gap)])
    y0 = top + np.concatenate([[0], np.cumsum(np.asarray(heights) + gap)])
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            y = int(y0[i]) + (heights[i] - picture.shape[0]) // 2
            x = int(x0[j]) + (widths[j] - picture.shape[1]) // 2
            target = sheet[y : y + picture.shape[0], x : x + picture.shape[1]]
            target[:] = _over(picture, target)
    if title:
        sheet = draw_text(sheet, title, (gap + 4, gap + 2), round(1.25 * text_size))
    for j, label in enumerate(column_labels):
        place = (int(x0[j]) + widths[j] // 2, top - line + round(0.3 * text_size))
        sheet = draw_text(sheet, label, place, text_size, centred=True)
    for i, label in enumerate(row_labels):
        place = (gap + 4, int(y0[i]) + heights[i] // 2 - text_size // 2)
        sheet = draw_text(sheet, label, place, text_size)
    return sheet


def _over(
    picture: UInt8[np.ndarray, "H W C"], below: UInt8[np.ndarray, "H W 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """A picture, possibly transparent, over another."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:] / 255.0
    return np.round(alpha * picture[..., :3] + (1.0 - alpha) * below).astype(np.uint8)


def save_png(path: str | os.PathLike[str], picture: np.ndarray) -> None:
    """Write a picture (H, W, 3 or 4) as PNG, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if the picture is not uint8 with 3 or 4 channels.
    """
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(_checked(picture)).save(temporary, format="PNG")


def save_webp_animation(
    frames: Iterable[np.ndarray],
    path: str | os.PathLike[str],
    fps: float | int = 15.0,
    *,
    quality: int = 80,
) -> None:
    """Write frames of one size as a WebP animation that repeats, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if there are no frames, they differ in shape, or `fps` is not positive or above
            500.
    """
    _save_animation(frames, path, fps, "WEBP", quality=quality, method=2)


def save_gif_animation(
    frames: Iterable[np.ndarray], path: str | os.PathLike[str], fps: float | int = 15.0
) -> None:
    """Write frames of one size as a GIF that repeats, whole or not at all.

    GIF is limited to 256 colours and hundredths of a second: WebP files are smaller and better.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if there are no frames, they differ in shape, or `fps` is not positive or above
            50.
    """
    _save_animation(frames, path, fps, "GIF")


def _save_animation(
    frames: Iterable[np.ndarray],
    path: str | os.PathLike[str],
    fps: float | int,
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
    # Durations are whole units of the format; their sum keeps time.
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
    """The picture as a contiguous array, if it is valid."""
    array = np.ascontiguousarray(picture)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] not in (3, 4):
        raise ValueError(
            f"a picture must be uint8 of shape (H, W, 3) or (H, W, 4), found {array.dtype} "
            f"{array.shape}."
        )
    return array
