"""What makes two body models the same."""

from __future__ import annotations

import hashlib

import numpy as np
from jaxtyping import Int, Shaped

from ..kinematics import KinematicTree

_AT_ONCE = 1 << 20  # numbers: directions of a body are tens of millions


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
        flat = np.ascontiguousarray(array).reshape(-1)
        for start in range(0, len(flat), _AT_ONCE):
            part = flat[start : start + _AT_ONCE].astype(np.float64)
            digest.update(np.rint(part * 1e6).astype(np.int64).tobytes())
    return digest.hexdigest()
