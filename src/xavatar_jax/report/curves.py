"""A picture of how the losses went."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from ..render import draw_text
from ..training import History

_COLORS = (
    *((38, 84, 124), (214, 96, 47), (70, 140, 80), (150, 90, 160), (190, 150, 40), (90, 150, 170)),
    *((200, 80, 120), (110, 110, 110)),
)
_PAPER, _RULE, _TEXT = (246, 246, 248), (222, 222, 226), 13
_DRAWN_AT = 3  # lines are drawn so many times larger: PIL's own have jagged edges


def loss_curves(
    history: History, *, size: tuple[int, int] = (760, 420)
) -> UInt8[np.ndarray, "H W 3"]:
    """Terms of the loss and the validation loss against the step, on a logarithmic scale.

    Values that are zero or not finite are left out. `size` is width and height, pixels.

    **Raises:** `ValueError` if nothing was recorded that can be drawn.
    """
    steps = history.steps
    terms = {n: values for n, values in history.terms.items() if not n.endswith("gradient")}
    curves = {name: _drawable(steps, values) for name, values in terms.items() if name != "found"}
    curves["validation"] = _drawable(history.validated, history.validation)
    curves = {name: curve for name, curve in curves.items() if len(curve)}
    if not curves:
        raise ValueError("no losses were recorded: there is nothing to draw")
    return _plot(curves, size)


def _drawable(steps: Sequence[int], values: Sequence[float]) -> np.ndarray:
    """Rows of step and logarithm."""
    rows = [
        (step, math.log10(value))
        for step, value in zip(steps, values, strict=True)
        if math.isfinite(value) and value > 0
    ]
    return np.asarray(rows).reshape(-1, 2)


def _plot(curves: Mapping[str, np.ndarray], size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    from PIL import Image, ImageDraw

    width, height = size
    left, right, top, bottom = 64, width - 180, 18, height - 40
    everything = np.concatenate(list(curves.values()))
    first, last = everything[:, 0].min(), max(everything[:, 0].max(), everything[:, 0].min() + 1)
    low = math.floor(everything[:, 1].min())
    high = max(math.ceil(everything[:, 1].max()), low + 1)

    def place(row: Sequence[float]) -> tuple[float, float]:
        x = left + (row[0] - first) / (last - first) * (right - left)
        y = bottom - (row[1] - low) / (high - low) * (bottom - top)
        return x, y

    image = Image.new("RGB", (width * _DRAWN_AT, height * _DRAWN_AT), _PAPER)
    draw = ImageDraw.Draw(image)

    def line(points: Sequence[tuple[float, float]], color: tuple[int, ...], thick: float) -> None:
        scaled = [(_DRAWN_AT * x, _DRAWN_AT * y) for x, y in points]
        draw.line(scaled, fill=color, width=max(round(thick * _DRAWN_AT), 1), joint="curve")

    decades = range(low, high + 1)
    for decade in decades:
        line([place((first, decade)), place((last, decade))], _RULE, 1)
    legend = []
    for k, (name, curve) in enumerate(curves.items()):
        color = _COLORS[k % len(_COLORS)]
        y = top + 10 + 20 * k
        legend.append((name, y))
        line([(right + 14, y), (right + 34, y)], color, 2.5)
        thick = 2.5 if name == "validation" else 1.3
        points = [place(row) for row in curve]
        # A single value is a short dash.
        line(points if len(points) > 1 else [points[0], (points[0][0] + 4, points[0][1])],
             color, thick)  # fmt: skip
    picture = np.asarray(image.resize(size, Image.Resampling.LANCZOS))
    for name, y in legend:
        picture = draw_text(picture, name, (right + 40, y - 9), _TEXT)
    for decade in decades:
        picture = draw_text(
            picture, f"1e{decade}", (12, round(place((first, decade))[1]) - 9), _TEXT
        )
    for step in (first, last):
        x = round(place((step, low))[0])
        picture = draw_text(picture, f"{step:.0f}", (x, bottom + 8), _TEXT, centred=True)
    middle = (left + right) // 2
    return draw_text(picture, "step", (middle, bottom + 8), _TEXT, centred=True)
