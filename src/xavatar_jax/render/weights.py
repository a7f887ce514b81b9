"""Colours for skinning weights: one bone as a ramp, or all bones, each in its own colour."""

import colorsys

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import ArrayLike

WEIGHT_RAMP = np.array([[206, 208, 212], [246, 166, 72], [176, 32, 44]], dtype=np.uint8)
"""Colours of weight 0, one half and 1."""


def bone_palette(count: int) -> UInt8[np.ndarray, "J 3"]:
    """A colour for each of `count` bones; neighbours in the list differ clearly.

    Raises:
        ValueError: if `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"{count} bones; at least one is needed.")
    # Hues by the golden ratio, so that any few in a row lie far apart; lightness in turn.
    hues = (0.58 + 0.6180339887 * np.arange(count)) % 1.0
    colors = [
        colorsys.hls_to_rgb(hue, (0.48, 0.62, 0.72)[k % 3], 0.52) for k, hue in enumerate(hues)
    ]
    return np.round(255 * np.asarray(colors)).astype(np.uint8)


def weight_colors(weights: ArrayLike, bone: int | None = None) -> UInt8[np.ndarray, "V 3"]:
    """Colours of skinning weights (V, J): of one bone, grey at 0 by orange to red at 1, or of all.

    Without a bone, each vertex gets the colours of its bones, mixed by weight.

    Raises:
        ValueError: if `weights` is not (V, J), or there is no such bone.
    """
    values = np.asarray(weights, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] == 0:
        raise ValueError(f"weights must have shape (V, J), found {values.shape}.")
    if bone is None:
        return np.round(_clipped(values) @ bone_palette(values.shape[1])).astype(np.uint8)
    if not 0 <= bone < values.shape[1]:
        raise ValueError(f"no bone {bone}: there are {values.shape[1]}, from 0.")
    own = np.clip(values[:, bone], 0.0, 1.0)
    channels = [np.interp(own, [0.0, 0.5, 1.0], WEIGHT_RAMP[:, i]) for i in range(3)]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)


def _clipped(weights: Float[np.ndarray, "V J"]) -> Float[np.ndarray, "V J"]:
    """Weights that sum to one, or to less where they did."""
    positive = np.maximum(weights, 0.0)
    return positive / np.maximum(positive.sum(axis=1, keepdims=True), 1.0)
