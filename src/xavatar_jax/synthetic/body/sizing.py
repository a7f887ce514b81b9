"""Target edge lengths of the mesh: fine at hands and face, coarse at the trunk."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .clothing import distance_to_lines
from .field import offset
from .head import EYE, MOUTH, MOUTH_HALF_WIDTH, NOSE_TIP, hair_edge

# |x| beyond which everything belongs to a hand.
WRIST_X = 0.692
_GROWTH = 0.45

# (centre, radius in which the length applies, edge length), metres, for x >= 0.
_DETAILS = (
    (offset(MOUTH, 0.012, 0.0, -0.006), 0.024, 0.0027),
    (offset(EYE, 0.0, 0.0, 0.010), 0.016, 0.0023),
    (offset(NOSE_TIP, 0.003, -0.005, -0.008), 0.014, 0.0035),
    (np.array([0.078, 0.318, -0.010]), 0.036, 0.0044),
    (np.array([0.030, 0.358, 0.072]), 0.020, 0.0033),
    (np.array([0.015, 0.300, 0.070]), 0.058, 0.0060),
    (np.array([0.025, 0.228, 0.038]), 0.030, 0.0085),
    (np.array([0.0, 0.345, 0.000]), 0.100, 0.0105),
    (np.array([0.125, -1.278, 0.110]), 0.050, 0.0068),
    (np.array([0.105, -1.250, 0.010]), 0.110, 0.0140),
    (np.array([0.0, -0.510, -0.010]), 0.040, 0.0120),
)


def edge_length(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Target edge length at points, metres."""
    p = np.array(points, dtype=np.float64)
    p[:, 0] = np.abs(p[:, 0])
    length = np.full(len(p), 0.0200)
    for centre, radius, value in _DETAILS:
        away = np.sqrt(((p - centre) ** 2).sum(1)) - radius
        length = np.minimum(length, value + _GROWTH * np.maximum(away, 0.0))
    hand = 0.0036 + _GROWTH * np.maximum(WRIST_X - 0.008 - p[:, 0], 0.0)
    length = np.minimum(length, hand)
    line = np.maximum(distance_to_lines(p) - 0.004, 0.0)
    length = np.minimum(length, 0.0100 + 0.8 * line)
    on_head = (p[:, 1] > 0.25) & (p[:, 0] < 0.1) & (p[:, 2] > -0.02)
    hair = np.where(on_head, np.maximum(np.abs(hair_edge(p)) - 0.004, 0.0), 1.0)
    return np.minimum(length, 0.0046 + 0.7 * hair)


def longest_edge(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Upper limit of edges that start at points, metres: 3.95 mm on hands, none elsewhere."""
    return np.where(np.abs(points[:, 0]) > WRIST_X - 0.002, 0.00395, np.inf)


def leaf_size(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Largest octree leaf at points, metres: the edge length, but finer between the lips."""
    size = edge_length(points)
    q = (points - MOUTH - (0.0, 0.0, -0.008)) / (MOUTH_HALF_WIDTH + 0.002, 0.004, 0.018)
    return np.where((q * q).sum(1) < 1.0, np.minimum(size, 0.0010), size)
