"""Part labels of template vertices: body, face, hands, eyes and mouth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int8

from ..kinematics import KinematicTree

PARTS = ("body", "face", "left_hand", "right_hand", "eyes_mouth")
"""Names of the parts; a part label is an index into them."""
BODY = PARTS.index("body")
"""Label of what is neither hand nor face."""
FACE = PARTS.index("face")
"""Label of the head without eyes and mouth."""
LEFT_HAND = PARTS.index("left_hand")
"""Label of the left hand, from the wrist."""
RIGHT_HAND = PARTS.index("right_hand")
"""Label of the right hand, from the wrist."""
EYES_MOUTH = PARTS.index("eyes_mouth")
"""Label of the eyes and the seam of the lips."""
HANDS = (LEFT_HAND, RIGHT_HAND)
"""Labels that count as hands."""
FACES = (FACE, EYES_MOUTH)
"""Labels that count as face."""


def derive_part_labels(
    tree: KinematicTree, weights: Float[np.ndarray, "V J"]
) -> Int8[np.ndarray, " V"]:
    """Labels from skinning weights and joint names, for models that carry none.

    A vertex belongs to a hand if most of its weight is on the wrist of that side and what is
    below, to the face if most is on the head and what is below. Of the face, what an eye moves
    most, and the seam that the jaw moves in part (the lips), is `eyes_mouth`. A tree without
    these names is all `body`.
    """
    labels = np.full(len(weights), BODY, np.int8)

    def mass(name: str) -> np.ndarray:
        joints = tree.indices(name)
        return weights[:, tree.subtree(joints[0])].sum(1) if joints else np.zeros(len(weights))

    face = mass("head") > 0.5
    labels[face] = FACE
    jaw = mass("jaw")
    eyes = np.maximum(mass("left_eye"), mass("right_eye"))
    labels[face & ((eyes > 0.5) | ((jaw > 0.1) & (jaw < 0.9)))] = EYES_MOUTH
    labels[mass("left_wrist") > 0.5] = LEFT_HAND
    labels[mass("right_wrist") > 0.5] = RIGHT_HAND
    return labels
