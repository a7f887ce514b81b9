"""Skinning weights in one `.npz`, for programs of one's own."""

import os

import numpy as np

from ..files import atomic_path
from .rig import Rig


def write_weights(path: str | os.PathLike[str], rig: Rig) -> None:
    """Write a rig's skinning to a plain `.npz`: no pickle, metres, y up.

    Entries: `weights` (V, J), `vertices` (V, 3) and `faces` (F, 3) of the bind pose,
    `joint_names` (J,), `parents` (J,) with -1 for the root, `rest_joints` (J, 3) in the world of
    the bind pose, `bind_transforms` (J, 4, 4) from a joint's frame to that world.

    Raises:
        OSError: if the file cannot be written; what stood there before stays.
    """
    bind = rig.bind
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file,
            weights=rig.weights.astype(np.float32),
            vertices=rig.mesh.vertices.astype(np.float32),
            faces=rig.mesh.faces.astype(np.int32),
            joint_names=np.asarray(rig.tree.names, dtype=np.str_),
            parents=np.asarray(rig.tree.parents, np.int32),
            rest_joints=bind[:, :3, 3].astype(np.float32),
            bind_transforms=bind.astype(np.float32),
        )
