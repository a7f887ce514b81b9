"""Lines over numbers, as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

_PER_INCH = 100


def line_chart(
    lines: Mapping[str, Sequence[tuple[float, float]]],
    *,
    x_label: str,
    title: str = "",
    x_ticks: Sequence[float] | None = None,
    log_x: bool = True,
    size: tuple[int, int] = (560, 420),
) -> UInt8[np.ndarray, "H W 3"]:
    """Named lines of (x, y), y on a logarithmic axis; the names stand below.

    - `x_ticks`: where the x axis has its numbers, if not where they are round.
    - `size`: width and height, pixels.
    """
    # Not pyplot: it looks for a display, and keeps what it has drawn.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = Figure(
        figsize=(size[0] / _PER_INCH, size[1] / _PER_INCH), dpi=_PER_INCH, layout="constrained"
    )
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name, points in lines.items():
        few = len(points) <= 12
        axes.plot(*zip(*points, strict=True), label=name, marker="o" if few else None, ms=4)
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    if log_x:
        axes.set_xscale("log")
    if x_ticks is not None:
        axes.set_xticks(x_ticks, [f"{x:,g}" if x < 1e6 else f"{x:,.0f}" for x in x_ticks])
        axes.set_xticks([], minor=True)
    axes.grid(alpha=0.3)
    axes.set_xlabel(x_label)
    axes.set_title(title)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
