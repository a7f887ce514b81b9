"""A picture of how the losses went."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from ..training import History
from .charts import line_chart


def loss_curves(
    history: History, *, size: tuple[int, int] = (760, 460)
) -> UInt8[np.ndarray, "H W 3"]:
    """Terms of the loss and the validation loss against the step, on a logarithmic scale.

    Values that are zero or not finite are left out. `size` is width and height, pixels.

    **Raises:** `ValueError` if nothing was recorded that can be drawn.
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
