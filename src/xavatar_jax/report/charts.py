"""Line charts as pictures, and the losses of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from ..learning import History

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
    """Named lines of (x, y) with a logarithmic y axis and the legend below.

    - `x_ticks`: positions of the labels on the x axis. Default: round numbers.
    - `size`: width and height in pixels.
    """
    # Not pyplot, which looks for a display and keeps its figures.
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


def loss_curves(
    history: History, *, size: tuple[int, int] = (760, 460)
) -> UInt8[np.ndarray, "H W 3"]:
    """Loss terms and validation loss against the training step, on a logarithmic scale.

    Values that are zero or not finite are left out. `size` is width and height in pixels.

    **Raises:** `ValueError` if no value can be drawn.
    """
    steps = history.steps
    terms = {n: values for n, values in history.terms.items() if not n.endswith("gradient")}
    curves = {name: _drawable(steps, values) for name, values in terms.items() if name != "found"}
    curves["validation"] = _drawable(history.validated, history.validation)
    curves = {name: curve for name, curve in curves.items() if curve}
    if not curves:
        raise ValueError("no losses were recorded: there is nothing to draw")
    return line_chart(curves, x_label="step", log_x=False, size=size)


def _drawable(steps: Sequence[int], values: Sequence[float]) -> list[tuple[float, float]]:
    return [
        (step, value)
        for step, value in zip(steps, values, strict=True)
        if math.isfinite(value) and value > 0
    ]
