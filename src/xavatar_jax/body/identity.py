"""What makes two body models the same."""

from __future__ import annotations

import hashlib

import numpy as np
from jaxtyping import Int, Shaped

from ..kinematics import KinematicTree


def body_checksum(
    tree: KinematicTree, faces: Int[np.ndarray, "F 3"], *arrays: Shaped[np.ndarray, "..."]
) -> str:
    """SHA-256 of a tree, of faces and of arrays to six decimals, as hexadecimal digits.

    Of contents and not of a file's bytes: a model is the same in an `.npz` and a `.pkl`, and what
    code has made is the same where another processor rounds otherwise.
    """
    digest = hashlib.sha256(repr((tree.names, tree.parents)).encode())
    digest.update(np.ascontiguousarray(faces, np.int32).tobytes())
    for array in arrays:
        digest.update(np.rint(np.asarray(array, np.float64) * 1e6).astype(np.int64).tobytes())
    return digest.hexdigest()
