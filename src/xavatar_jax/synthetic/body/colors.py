"""Vertex colours: skin, lips, brows, eyes, short hair, T-shirt, trousers and socks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from .clothing import CUFF, HEM, SLEEVE, neckline
from .head import (
    EYE,
    EYE_RADIUS,
    MOUTH,
    hair_edge,
    lid_opening,
    mouth_line,
)

_SKIN = np.array([222, 172, 142.0])
_LIPS = np.array([186, 104, 98.0])
_CHEEK = np.array([224, 150, 126.0])
_HAIR = np.array([72, 50, 38.0])
_MOUTH = np.array([96, 40, 42.0])
_WHITE = np.array([240, 238, 234.0])
_IRIS = np.array([72, 104, 128.0])
_PUPIL = np.array([20, 18, 20.0])
_SHIRT = np.array([74, 128, 150.0])
_TROUSERS = np.array([58, 64, 84.0])


def _soft(inside: np.ndarray, width: float) -> np.ndarray:
    """One where `inside` is well above zero, zero below, linear across `width`."""
    return np.clip(inside / width + 0.5, 0.0, 1.0)[:, None]


def synthetic_colors(vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, "V 3"]:
    """Colours (V, 3) uint8 of rest-pose vertices."""
    p = np.concatenate([np.abs(vertices[:, :1]), vertices[:, 1:]], 1)
    x, y, z = p.T
    color = np.tile(_SKIN, (len(p), 1))

    def paint(amount: np.ndarray, shade: np.ndarray) -> None:
        color[:] = color + amount * (shade - color)

    cheek = np.exp(-0.5 * (((p - (0.044, 0.298, 0.062)) / 0.014) ** 2).sum(1))
    paint(0.35 * cheek[:, None], _CHEEK)
    head = (x < 0.12) & (y + 0.45 * z > 0.236)
    # Lips: an outline in x and y around the mouth line.
    off = y - mouth_line(x)
    reach = np.clip(1.0 - (x / 0.0245) ** 2, 0.0, 1.0)
    bow = 0.0078 - 0.0012 * np.exp(-((x / 0.003) ** 2))
    lip = np.where(off > 0, bow * reach**0.8 - off, 0.0098 * reach**0.7 + off)
    lip = np.minimum(lip, 0.0240 - x)
    paint(_soft(np.where(head & (z > 0.066), lip, -1.0), 0.0016), _LIPS)
    pocket = head & (x < 0.0215) & (np.abs(y - MOUTH[1]) < 0.010) & (z > 0.045)
    paint(_soft(np.where(pocket, 0.0805 - z - 14.0 * x * x, -1.0), 0.004), _MOUTH)

    arch = 0.3570 + 0.10 * (x - 0.012) - 3.6 * np.maximum(x - 0.036, 0.0) ** 1.5
    brow = 0.0032 - 0.00004 / 0.012 * np.abs(x - 0.03) * 20 - np.abs(y - arch)
    brow = np.where(head & (x > 0.012) & (x < 0.051) & (z > 0.04), brow, -1.0)
    paint(0.9 * _soft(brow, 0.0032), _HAIR)

    # Lashes: the rim of the lids, darker above.
    rim = np.where(head & (z > EYE[2]) & (x > 0.012) & (x < 0.052), lid_opening(p), 1.0)
    dark = np.where(y > EYE[1] + 0.06 * (x - EYE[0]), 0.0013, 0.0002)
    paint(0.75 * _soft(dark - np.abs(rim - 0.0006), 0.0012), _HAIR)

    ball = np.linalg.norm(p - EYE, axis=1) < EYE_RADIUS + 0.0006
    seen = ball & (z > EYE[2]) & (lid_opening(p) < 0.0004)
    paint(_soft(np.where(seen, 1.0, -1.0), 0.1), _WHITE)
    ring = np.hypot(x - EYE[0], y - EYE[1])
    paint(_soft(np.where(seen, 0.0056 - ring, -1.0), 0.0016), _IRIS)
    paint(_soft(np.where(seen, 0.0024 - ring, -1.0), 0.0016), _PUPIL)
    ear = ((p - (0.0830, 0.316, -0.010)) / (0.0105, 0.038, 0.026)) ** 2
    hair = np.minimum(-hair_edge(p), 0.02 * (ear.sum(1) - 1.0))
    paint(_soft(np.where(head, hair, -1.0), 0.009), _HAIR)

    cloth = np.minimum(np.minimum(SLEEVE - x, y - HEM), -neckline(p))
    shirt = np.where(head | (y > 0.20), -1.0, cloth)
    # Trousers first, extending under the shirt, so that no skin shows between them.
    legs = np.minimum(HEM + 0.05 - y, y - CUFF)
    paint(_soft(np.where(x < 0.4, legs, -1.0), 0.009), _TROUSERS)
    paint(_soft(shirt, 0.009), _SHIRT)
    return np.clip(np.round(color), 0, 255).astype(np.uint8)
