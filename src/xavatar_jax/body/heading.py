"""Where a person stands and looks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..kinematics import TO_Y_UP
from .params import BodyParams


def root_rotation(params: BodyParams) -> Float[np.ndarray, "3 3"]:
    """Orientation of the person of one frame in the world."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.array(params.pose[0], np.float64)).as_matrix()


def facing(params: BodyParams, up: str = "y") -> Float[np.ndarray, "3"]:
    """Where the person of one frame looks, along the ground: the root's rotation of +Z."""
    to_y_up = TO_Y_UP[up]
    ahead, vertical = root_rotation(params)[:, 2], to_y_up[1]
    ahead = ahead - (ahead @ vertical) * vertical
    length = float(np.linalg.norm(ahead))
    if length < 1e-3:
        return to_y_up.T @ np.array([0.0, 0.0, 1.0])
    return ahead / length
