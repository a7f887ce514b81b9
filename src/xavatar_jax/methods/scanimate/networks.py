"""SCANimate's networks: forward and inverse skinning, a distance that reads the pose locally."""

from __future__ import annotations

from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ...body import BodyParams
from ...fields import (
    AbstractPlainGeometry,
    AbstractSkinningField,
    GeometryValue,
    ImplicitMLP,
    MLPShape,
    stored,
)
from ...kinematics import KinematicTree

_FLOOR = 1e-4  # added to known weights: zeros have no logarithm
_STEPS = 4  # along the tree, that a joint's rotation is read


class SoftmaxSkinning(AbstractSkinningField):
    """The forward net: a canonical point to weights by a plain softmax."""

    mlp: ImplicitMLP

    def __init__(self, tree: KinematicTree, shape: MLPShape, *, key: PRNGKeyArray):
        self.mlp = ImplicitMLP(shape, outputs=tree.num_joints, key=key)

    def __call__(self, x_c: Float[Array, "3"]) -> Float[Array, " J"]:
        return jax.nn.softmax(self.mlp(x_c))

    def covers(self, x_c: Float[Array, "3"]) -> Array:
        return jnp.all(jnp.isfinite(x_c))


class InverseSkinning(eqx.Module):
    """The inverse net: a posed point and its frame's latent vector to weights.

    With `known`, the weights at the body's nearest point are what it begins from.
    """

    mlp: ImplicitMLP
    latents: Float[Array, "F k"]
    known: bool = eqx.field(static=True)

    def __init__(
        self,
        tree: KinematicTree,
        shape: MLPShape,
        *,
        frames: int,
        latent: int,
        known: bool,
        key: PRNGKeyArray,
    ):
        mlp = ImplicitMLP(shape, outputs=tree.num_joints, condition=latent, key=key)
        if known:
            # Silent at first.
            mlp = eqx.tree_at(lambda m: (m.layers[-1].length, m.layers[-1].bias), mlp,
                              replace_fn=jnp.zeros_like)  # fmt: skip
        self.mlp = mlp
        self.latents = jnp.zeros((frames, latent))
        self.known = known

    def __call__(
        self, x_d: Float[Array, "3"], latent: Float[Array, " k"], known: Float[Array, " J"]
    ) -> Float[Array, " J"]:
        """Weights at `x_d`, metres in the frame of the posed root."""
        logits = self.mlp(x_d, latent)
        if self.known:
            logits = logits + jnp.log(known + _FLOOR)
        return jax.nn.softmax(logits)


class LocalPoseMLP(AbstractPlainGeometry):
    """A distance network whose condition is local: each joint's quaternion counts by how near the
    point's bones are to that joint along the tree.

    Its logit is the distance, positive inside, over `softness` metres. The skinning weights that
    it reads are not learned by it, and have no part in its gradient.
    """

    mlp: ImplicitMLP
    skinning: AbstractSkinningField = stored()
    tree: KinematicTree = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]
    softness: float = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]

    def __init__(
        self,
        tree: KinematicTree,
        skinning: AbstractSkinningField,
        shape: MLPShape,
        *,
        softness: float,
        key: PRNGKeyArray,
    ):
        self.mlp = ImplicitMLP(shape, condition=4 * (tree.num_joints - 1), init="ball", key=key)
        self.skinning = skinning
        self.tree = tree
        self.softness = softness

    def condition(self, params: BodyParams) -> Float[Array, "joints 4"]:
        return quaternions(params.pose[1:])

    def __call__(self, x_c: Float[Array, "3"], condition: Float[Array, "j 4"]) -> GeometryValue:
        weights = jax.lax.stop_gradient(self.skinning(x_c))
        shares = weights @ jnp.asarray(adjacency(self.tree)[:, 1:], weights.dtype)
        out = self.mlp(x_c, (shares[:, None] * condition).reshape(-1))
        return GeometryValue(out[0] / self.softness)


def quaternions(rotation: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Unit quaternions, real part first, of axis-angle vectors."""
    angle = jnp.sqrt((rotation**2).sum(-1, keepdims=True) + 1e-16)
    return jnp.concatenate([jnp.cos(angle / 2), jnp.sin(angle / 2) / angle * rotation], -1)


@lru_cache
def adjacency(tree: KinematicTree) -> Float[np.ndarray, "J J"]:
    """How much of a joint's rotation a bone reads: less with each step along the tree, up to four.

    Rows, one a bone, sum to one.
    """
    linked = np.zeros((tree.num_joints, tree.num_joints), bool)
    for joint, parent in enumerate(tree.parents[1:], start=1):
        linked[joint, parent] = linked[parent, joint] = True
    away = np.full(linked.shape, _STEPS + 1)
    reached = np.eye(tree.num_joints, dtype=bool)
    for step in range(_STEPS + 1):
        away[reached & (away > step)] = step
        reached = reached | (reached @ linked)
    share = (_STEPS + 1.0 - away) / (_STEPS + 1)
    return share / share.sum(1, keepdims=True)
