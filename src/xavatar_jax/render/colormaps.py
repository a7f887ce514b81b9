"""Colours for errors, with a bar that explains them, and for skinning weights."""

import colorsys

import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from .images import BACKGROUND, draw_text

# From blue through yellow to red; lightness peaks in the middle, saturation at the end.
_TABLE = np.array(
    [
        *([46, 74, 138], [48, 124, 168], [82, 170, 164], [154, 205, 140]),
        *([242, 222, 108], [246, 166, 72], [226, 96, 62], [164, 28, 48]),
    ],
    dtype=np.float64,
)
WEIGHT_RAMP = np.array([[206, 208, 212], [246, 166, 72], [176, 32, 44]], dtype=np.uint8)
"""Colours of the weights 0, one half and 1."""


def error_colors(errors_mm: ArrayLike, max_mm: float) -> UInt8[np.ndarray, "V 3"]:
    """Colours (V, 3) for errors (V,) in mm: blue at 0, yellow in the middle, red from `max_mm`.

    NaN errors become grey.

    Raises:
        ValueError: if `max_mm` is not positive.
    """
    if not max_mm > 0:
        raise ValueError(f"max_mm must be positive, found {max_mm}.")
    errors = np.asarray(errors_mm, dtype=np.float64)
    colors = _on_ramp(np.nan_to_num(errors) / max_mm, _TABLE)
    colors[np.isnan(errors)] = 160
    return colors


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


def bone_palette(count: int) -> UInt8[np.ndarray, "J 3"]:
    """A colour for each of `count` bones; consecutive ones differ clearly.

    Raises:
        ValueError: if `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"{count} bones; at least one is needed.")
    # Hues by the golden ratio, so that any few in a row are far apart; lightness alternates.
    hues = (0.58 + 0.6180339887 * np.arange(count)) % 1.0
    colors = [
        colorsys.hls_to_rgb(hue, (0.48, 0.62, 0.72)[k % 3], 0.52) for k, hue in enumerate(hues)
    ]
    return np.round(255 * np.asarray(colors)).astype(np.uint8)


def weight_colors(weights: ArrayLike, bone: int | None = None) -> UInt8[np.ndarray, "V 3"]:
    """Colours of skinning weights (V, J): of one bone, from grey (0) through orange to red (1).

    Without a bone, each vertex gets the colours of its bones, mixed by weight.

    Raises:
        ValueError: if `weights` is not (V, J), or there is no such bone.
    """
    values = np.asarray(weights, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] == 0:
        raise ValueError(f"weights must have shape (V, J), found {values.shape}.")
    if bone is None:
        positive = np.maximum(values, 0.0)
        mixed = positive / np.maximum(positive.sum(axis=1, keepdims=True), 1.0)
        return np.round(mixed @ bone_palette(values.shape[1])).astype(np.uint8)
    if not 0 <= bone < values.shape[1]:
        raise ValueError(f"no bone {bone}: there are {values.shape[1]}, from 0.")
    return _on_ramp(values[:, bone], WEIGHT_RAMP)


def _on_ramp(values: np.ndarray, ramp: np.ndarray) -> UInt8[np.ndarray, "... 3"]:
    """Colours of values from 0 to 1, clipped, between the evenly spaced rows of a ramp."""
    place, nodes = np.clip(values, 0.0, 1.0) * (len(ramp) - 1), np.arange(len(ramp))
    colors = np.stack([np.interp(place, nodes, ramp[:, i]) for i in range(3)], axis=-1)
    return np.round(colors).astype(np.uint8)
