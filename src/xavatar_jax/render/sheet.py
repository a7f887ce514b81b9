"""Several pictures on one sheet, with labels."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

BACKGROUND = (0.965, 0.965, 0.97)
"""Of pictures and sheets, sRGB."""
_TEXT_COLOR = (60, 62, 68)


def draw_text(
    picture: UInt8[np.ndarray, "H W 3"],
    text: str,
    at: tuple[int, int],
    size: int = 15,
    *,
    centred: bool = False,
) -> UInt8[np.ndarray, "H W 3"]:
    """A copy of `picture` with dark text, its upper left (or upper middle) at `at` = (x, y)."""
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
    """Lay pictures out in rows, with labels over the columns and before the rows.

    Pictures are uint8 (h, w, 3 or 4). A row is as high as its highest picture, a column as wide
    as its widest; smaller pictures stand in the middle. Rows may differ in length.

    Raises:
        ValueError: if there are no pictures, or more labels than rows or columns.
    """
    count = max((len(row) for row in rows), default=0)
    if count == 0:
        raise ValueError("no pictures to lay out.")
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
    """A picture, perhaps transparent, over another."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:] / 255.0
    return np.round(alpha * picture[..., :3] + (1.0 - alpha) * below).astype(np.uint8)
