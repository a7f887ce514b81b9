"""Borders of the painted clothes; the mesh is finer along them to keep them sharp."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

HEM = -0.385  # T-shirt over trousers, height
CUFF = -1.165  # end of the trousers, height
SLEEVE = 0.315  # end of the sleeves, |x|


def neckline(p: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Approximate distance to the edge of the T-shirt's neck hole, positive inside the hole."""
    q = (p - np.array([0.0, 0.175, 0.002])) / np.array([0.090, 0.090, 0.104])
    return 0.09 * (1.0 - np.sqrt((q * q).sum(1)))


def distance_to_lines(p: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Approximate distance to the nearest border between colours of the clothes."""
    x, y = np.abs(p[:, 0]), p[:, 1]
    on_trunk = x < 0.30
    away = np.where(on_trunk, np.minimum(np.abs(y - HEM), np.abs(y - CUFF)), 1.0)
    away = np.minimum(away, np.abs(x - SLEEVE))
    collar = np.where(y < 0.20, np.abs(neckline(p)), 1.0)
    return np.minimum(away, collar)
