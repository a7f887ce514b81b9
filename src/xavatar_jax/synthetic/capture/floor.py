"""Place a motion on the floor."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ...body import BodyModel, BodyParams, pose_body
from ...motion import Motion

_LOW_JOINTS = ("left_ankle", "right_ankle")


def on_floor(motion: Motion, body: BodyModel) -> Motion:
    """The y-up motion with the lowest point of the feet at height zero in every frame."""
    lowest = _lowest(body, motion)
    transl = motion.transl.copy()
    transl[:, 1] -= lowest
    return replace(motion, transl=transl)


_CHUNK = 64


@eqx.filter_jit
def _lowest_of_chunk(feet: BodyModel, params: BodyParams) -> Float[Array, " chunk"]:
    return jax.vmap(lambda p: pose_body(feet, p).vertices[:, 1].min())(params)


def _lowest(body: BodyModel, motion: Motion) -> Float[np.ndarray, " T"]:
    """Height of the lowest vertex of the feet in every frame, metres."""
    feet = _vertices_of(body, _LOW_JOINTS)
    params = jax.tree.map(np.asarray, motion.to_params(body))
    heights = []
    for start in range(0, len(motion), _CHUNK):
        # The last chunk repeats its last frame, so that all chunks have one shape.
        index = np.minimum(np.arange(start, start + _CHUNK), len(motion) - 1)
        heights.append(np.asarray(_lowest_of_chunk(feet, params[index])))
    return np.concatenate(heights)[: len(motion)].astype(np.float64)


def _vertices_of(body: BodyModel, joints: tuple[str, ...]) -> BodyModel:
    """The part of a body that follows the given joints and their descendants."""
    moved = [j for name in joints for j in body.tree.subtree(body.tree.index(name))]
    chosen = np.flatnonzero(np.asarray(body.weights)[:, moved].sum(1) > 0.5)
    names = ("template", "shape_dirs", "expression_dirs", "pose_dirs", "weights")
    return eqx.tree_at(
        lambda b: [getattr(b, name) for name in names],
        body,
        [getattr(body, name)[chosen] for name in names],
    )
