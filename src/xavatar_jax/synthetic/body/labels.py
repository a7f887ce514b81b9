"""Part labels of the surface."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ...body.parts import STANDARD_PARTS
from .head import EYE, MOUTH, MOUTH_HALF_WIDTH, hair_edge
from .sizing import WRIST_X

BODY, FACE, LEFT_HAND, RIGHT_HAND, EYES_MOUTH = range(len(STANDARD_PARTS))


def part_labels(vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """Labels (int8): 0 body, 1 face, 2 left hand, 3 right hand, 4 eyes and mouth."""
    p = np.concatenate([np.abs(vertices[:, :1]), vertices[:, 1:]], 1)
    label = np.full(len(p), BODY, dtype=np.int8)
    in_front = (p[:, 0] < 0.085) & (p[:, 2] > 0.010) & (p[:, 1] + 0.45 * p[:, 2] > 0.236)
    label[in_front & (hair_edge(p) > 0.0)] = FACE
    eye = np.linalg.norm((p - EYE - (0.0, 0.0, 0.008)) / (1.15, 0.85, 1.0), axis=1) < 0.0165
    mouth = (p - MOUTH - (0.0, 0.0, -0.012)) / (MOUTH_HALF_WIDTH + 0.005, 0.0135, 0.034)
    inner = (mouth * mouth).sum(1) < 1.0
    label[(eye & (p[:, 2] > EYE[2])) | (inner & (p[:, 2] > 0.045))] = EYES_MOUTH
    hand = p[:, 0] > WRIST_X
    label[hand & (vertices[:, 0] > 0)] = LEFT_HAND
    label[hand & (vertices[:, 0] < 0)] = RIGHT_HAND
    return label
