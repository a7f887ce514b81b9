"""World axes: y up as in the SMPL family, z up as in AMASS."""

from __future__ import annotations

import numpy as np

TO_Y_UP = {"y": np.eye(3), "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])}
"""By the axis that points up, the rotation to a world whose y axis does; x stays where it is."""
