"""What a baseline gives: an avatar on a body-only skeleton, asked in poses of the whole body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..avatar import Avatar
from ..body import BodyModel, BodyParams, with_betas
from ..frames import Frames, posed_vertices
from ..meshing import Mesh
from ..training import History
from .skeleton import body_only_params


@dataclass(frozen=True)
class Baseline:
    """A learned baseline: `evaluate` takes it, as it takes an `Avatar`.

    - `body`: the whole body, whose parameters `mesh` takes.
    - `avatar`: on the body-only skeleton; what it can do, it does with that body's parameters.
    - `frames`: those of the training frames that it was learned from, with its own parameters.
    """

    body: BodyModel
    avatar: Avatar
    history: History
    frames: Frames

    def mesh(self, params: BodyParams, *, mode: Literal["fast", "full"] = "fast") -> Mesh:
        """The posed surface of one frame of the whole body, metres: see `Avatar.mesh`."""
        return self.avatar.mesh(body_only_params(self.avatar.body, params), mode=mode)

    def posed_template(self, params: BodyParams) -> Float[np.ndarray, "V 3"]:
        """Vertices of the whole body in this pose and the person's shape, metres."""
        own = with_betas(params, self.avatar.betas)
        return np.asarray(posed_vertices(self.body, own), np.float64)
