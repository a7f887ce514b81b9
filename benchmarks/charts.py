"""Line charts on logarithmic axes, drawn without a plotting library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from xavatar_jax.render.sheet import draw_text

_COLORS = ((31, 119, 180), (214, 96, 32), (44, 140, 60), (120, 80, 170), (110, 110, 110))


def tick(value: float) -> str:
    """A number at an axis: whole ones with their thousands apart, others as they are."""
    return f"{value:,.0f}" if value >= 1 and value == int(value) else f"{value:g}"


def log_chart(
    lines: Mapping[str, Sequence[tuple[float, float]]],
    *,
    title: str,
    x_label: str,
    x_ticks: Sequence[float],
    size: tuple[int, int] = (560, 420),
) -> UInt8[np.ndarray, "H W 3"]:
    """Named lines of (x, y), both axes logarithmic; a horizontal rule at each power of ten."""
    from PIL import Image, ImageDraw

    width, height = size
    left, right, top, bottom = 78, 40, 40, 58
    points = np.array([p for line in lines.values() for p in line], float)
    low, high = np.log10(points.min(0)), np.log10(points.max(0))
    low[1], high[1] = np.floor(low[1]), np.ceil(high[1] + 1e-9)
    span = np.maximum(high - low, 1e-9)

    def place(x: float, y: float) -> tuple[float, float]:
        u, v = (np.log10([x, y]) - low) / span
        return left + u * (width - left - right), height - bottom - v * (height - top - bottom)

    image = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(image)
    powers = [10.0**k for k in range(int(low[1]), int(high[1]) + 1)]
    for y in powers:
        _, v = place(10 ** low[0], y)
        draw.line([(left, v), (width - right, v)], fill=(225, 225, 228))
    for color, line in zip(_COLORS, lines.values(), strict=False):
        spots = [place(*p) for p in line]
        draw.line(spots, fill=color, width=3)
        for u, v in spots:
            draw.ellipse([u - 4, v - 4, u + 4, v + 4], fill=color)
    for k, color in enumerate(_COLORS[: len(lines)]):
        draw.rectangle([left + 10, top + 8 + 20 * k, left + 24, top + 14 + 20 * k], fill=color)
    picture = np.asarray(image)
    for k, name in enumerate(list(lines)[: len(_COLORS)]):
        picture = draw_text(picture, name, (left + 32, top + 2 + 20 * k), 13)
    for y in powers:
        picture = draw_text(picture, tick(y), (8, int(place(10 ** low[0], y)[1]) - 8), 13)
    for x in x_ticks:
        at = (int(place(x, 10 ** low[1])[0]), height - bottom + 8)
        picture = draw_text(picture, tick(x), at, 13, centred=True)
    picture = draw_text(picture, x_label, ((left + width) // 2, height - 26), 14, centred=True)
    return draw_text(picture, title, (8, 10), 15)
