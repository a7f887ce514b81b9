"""Colours for errors, and the bar that explains them."""

import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from .sheet import BACKGROUND, draw_text

# From calm blue by yellow to red, with lightness rising to the middle and saturation to the end.
_TABLE = np.array(
    [
        [46, 74, 138],
        [48, 124, 168],
        [82, 170, 164],
        [154, 205, 140],
        [242, 222, 108],
        [246, 166, 72],
        [226, 96, 62],
        [164, 28, 48],
    ],
    dtype=np.float64,
)


def error_colors(errors_mm: ArrayLike, max_mm: float) -> UInt8[np.ndarray, "V 3"]:
    """Colours (V, 3) for errors (V,) in mm: blue at 0, yellow in the middle, red from `max_mm`.

    An error that is NaN becomes grey.

    Raises:
        ValueError: if `max_mm` is not positive.
    """
    if not max_mm > 0:
        raise ValueError(f"max_mm must be positive, found {max_mm}.")
    errors = np.asarray(errors_mm, dtype=np.float64)
    place = np.clip(np.nan_to_num(errors) / max_mm, 0.0, 1.0) * (len(_TABLE) - 1)
    nodes = np.arange(len(_TABLE))
    colors = np.stack([np.interp(place, nodes, _TABLE[:, i]) for i in range(3)], axis=-1)
    colors[np.isnan(errors)] = 160.0
    return np.round(colors).astype(np.uint8)


def color_bar(
    max_mm: float,
    size: tuple[int, int] = (70, 512),
    *,
    background: tuple[float, float, float] = BACKGROUND,
) -> UInt8[np.ndarray, "H W 3"]:
    """A vertical bar of the error colours with its scale in mm; `size` is width and height.

    Raises:
        ValueError: if `max_mm` is not positive or the size is too small for its text.
    """
    width, height = size
    if width < 50 or height < 60:
        raise ValueError(f"size must be at least (50, 60) pixels, found {size}.")
    picture = np.empty((height, width, 3), dtype=np.uint8)
    picture[:] = np.round(np.asarray(background) * 255.0)
    top, bottom = height // 8, height - height // 8
    levels = np.linspace(max_mm, 0.0, bottom - top)
    bar = error_colors(levels, max_mm)
    picture[top:bottom, 6:22] = bar[:, None]
    for part in (0.0, 0.5, 1.0):
        row = round(bottom - part * (bottom - top))
        text = f"{part * max_mm:.3g}"
        picture = draw_text(picture, text, (27, row - 7), 13)
    return draw_text(picture, "mm", (6, bottom + 8), 13)
