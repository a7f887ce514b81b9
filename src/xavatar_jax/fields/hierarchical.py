"""Hierarchical softmax: logits to skinning weights by walking down the kinematic tree.

Probability mass enters at the root. A joint with one child keeps a share of what arrives and
passes on the rest, by the child's logit; a joint with several children has a gate logit for what
it passes on, and its children share that by a softmax (SNARF's skinning network; X-Avatar,
supplementary code). The weights are non-negative and sum to one by construction.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import KinematicTree

SOFT_BLEND = 20.0
"""Factor on a network's outputs before the softmax, as in X-Avatar's released code."""


class _Layout(NamedTuple):
    """Index arrays of a tree. J joints, G groups of siblings, S the largest group."""

    num_logits: int
    gate: np.ndarray  # (J,) logit that gates what a joint passes on; leaves: 0, masked
    is_leaf: np.ndarray  # (J,)
    parent: np.ndarray  # (J,)
    siblings: np.ndarray  # (G, S) joints of each group with two or more, padded with 0
    sibling_mask: np.ndarray  # (G, S)
    group_of: np.ndarray  # (J,) group of a joint, or G for an only child and the root
    paths: np.ndarray  # (J, J): row j has ones at j and its ancestors, the root left out


@lru_cache
def _layout(tree: KinematicTree) -> _Layout:
    count = tree.num_joints
    # 32 bits: JAX remembers the width that a 64-bit index array had under the other x64 setting.
    gate = np.zeros(count, np.int32)
    leaf = np.zeros(count, bool)
    groups: list[tuple[int, ...]] = []
    group_of = np.full(count, -1, np.int32)
    # The root needs no logit of its own: index 0 is its gate. Later branches get new logits.
    extra = count
    for joint in range(count):
        children = tree.children(joint)
        if not children:
            leaf[joint] = True
        elif len(children) == 1 and joint > 0:
            gate[joint] = children[0]
        elif joint == 0:
            gate[joint] = 0
        else:
            gate[joint] = extra
            extra += 1
        if len(children) > 1:
            group_of[list(children)] = len(groups)
            groups.append(children)
    width = max((len(g) for g in groups), default=1)
    siblings = np.zeros((max(len(groups), 1), width), np.int32)
    mask = np.zeros(siblings.shape, bool)
    for row, members in enumerate(groups):
        siblings[row, : len(members)] = members
        mask[row, : len(members)] = True
    group_of[group_of < 0] = len(groups)
    paths = np.zeros((count, count))
    for joint in range(count):
        node = joint
        while node > 0:
            paths[joint, node] = 1
            node = tree.parents[node]
    parents = np.maximum(np.asarray(tree.parents, np.int32), 0)
    return _Layout(extra, gate, leaf, parents, siblings, mask, group_of, paths)


def num_logits(tree: KinematicTree) -> int:
    """Logits the tree needs: one a joint, and a gate for each branching joint but the root."""
    return _layout(tree).num_logits


def hierarchical_softmax(
    tree: KinematicTree, logits: Float[Array, "*points L"]
) -> Float[Array, "*points J"]:
    """Skinning weights from logits (already multiplied by the soft blend)."""
    lay = _layout(tree)
    if logits.shape[-1] != lay.num_logits:
        raise ValueError(
            f"{logits.shape[-1]} logits for a tree of {tree.num_joints} joints, which needs "
            f"{lay.num_logits}"
        )
    gates = logits[..., lay.gate]
    # The logarithms of a sigmoid and of its complement, with one exponential for both.
    common = jnp.log1p(jnp.exp(-jnp.abs(gates)))
    passed = jnp.minimum(gates, 0) - common
    kept = jnp.where(lay.is_leaf, 0.0, -jnp.maximum(gates, 0) - common)
    group_logits = jnp.where(lay.sibling_mask, logits[..., lay.siblings], -jnp.inf)
    none = jnp.zeros_like(logits[..., :1])  # the group of joints that have no siblings
    if lay.sibling_mask.any():
        # Shares are taken from the largest sibling's logit: in float32 the difference to a sum of
        # large logits would lose the digits that make the shares sum to one. Derivatives likewise:
        # those of a share near one are differences to that logit's.
        peak = jnp.max(group_logits, axis=-1)
        total = jax.nn.logsumexp(group_logits - peak[..., None], axis=-1)
        peak, total = (jnp.concatenate([value, none], axis=-1) for value in (peak, total))
    else:
        peak = total = none
    lone = lay.group_of == (total.shape[-1] - 1)
    own = logits[..., : tree.num_joints] - peak[..., lay.group_of]
    share = jnp.where(lone, 0.0, own - total[..., lay.group_of])
    entered = passed[..., lay.parent] + share
    # log m_j is the sum of what each ancestor let through.
    arrived = jnp.matmul(
        entered, lay.paths.T.astype(logits.dtype), precision=jax.lax.Precision.HIGHEST
    )
    return jnp.exp(arrived + kept)


def hierarchical_logits(
    tree: KinematicTree, weights: Float[np.ndarray, "N J"], floor: float = 1e-4
) -> Float[np.ndarray, "N L"]:
    """Logits whose `hierarchical_softmax` is near the given weights (NumPy, at data time).

    `floor` is added to every weight: zeros have no finite logit. A joint whose subtree gets no
    mass keeps neutral logits below it.
    """
    lay = _layout(tree)
    weights = np.asarray(weights, np.float64) + floor / tree.num_joints
    weights = weights / weights.sum(1, keepdims=True)
    # Mass of every subtree: a column of `paths` (plus the root) lists the joint's descendants.
    below = lay.paths.copy()
    below[:, 0] = 1
    mass = weights @ below
    logits = np.zeros((len(weights), lay.num_logits))
    for joint in range(tree.num_joints):
        children = tree.children(joint)
        if not children:
            continue
        down = mass[:, list(children)].sum(1)
        logits[:, lay.gate[joint]] = np.log(down / weights[:, joint])
        if len(children) > 1:
            shares = np.log(mass[:, list(children)])
            logits[:, list(children)] = shares - shares.mean(1, keepdims=True)
    return logits
