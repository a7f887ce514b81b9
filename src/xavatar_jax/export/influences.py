"""Skinning weights of few bones a vertex, as file formats and graphics cards take them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Influences(NamedTuple):
    """Bones `(V, k)` of every vertex, heaviest first, and their weights `(V, k)`, float32.

    Rows of weights sum to one; an entry without weight names bone 0.
    """

    joints: Int[np.ndarray, "V k"]
    weights: Float[np.ndarray, "V k"]

    def dense(self, num_joints: int) -> Float[np.ndarray, "V J"]:
        """The same weights over all bones."""
        full = np.zeros((len(self.joints), num_joints), np.float32)
        # Entries without weight may name bone 0 a second time: added, not written.
        np.add.at(full, (np.arange(len(full))[:, None], self.joints), self.weights)
        return full


def limit_influences(weights: Float[np.ndarray, "V J"], count: int) -> Influences:
    """The `count` heaviest bones of every vertex, their weights scaled to sum to one.

    Fewer than `count` bones, or weights below a millionth, leave entries of weight zero.

    Raises:
        ValueError: if a vertex has no weight at all, or `count` is less than one.
    """
    if count < 1:
        raise ValueError(f"{count} influences; at least one is needed")
    weights = np.asarray(weights, np.float64)
    kept = min(count, weights.shape[1])
    joints = np.argpartition(-weights, kept - 1, axis=1)[:, :kept]
    chosen = np.take_along_axis(weights, joints, axis=1)
    order = np.argsort(-chosen, axis=1, kind="stable")
    joints = np.take_along_axis(joints, order, axis=1)
    chosen = np.take_along_axis(chosen, order, axis=1)
    if not (chosen[:, 0] > 0).all():
        vertex = int(np.flatnonzero(~(chosen[:, 0] > 0))[0])
        raise ValueError(f"skinning weights of vertex {vertex} are not positive: it hangs nowhere")
    chosen = np.where(chosen < 1e-6 * chosen[:, :1], 0.0, chosen)
    chosen = (chosen / chosen.sum(1, keepdims=True)).astype(np.float32)
    joints = np.where(chosen > 0, joints, 0)
    missing = ((0, 0), (0, count - kept))
    return Influences(np.pad(joints, missing), np.pad(chosen, missing))
