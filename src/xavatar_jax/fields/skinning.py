"""Skinning fields: a canonical point to weights over the bones."""

from __future__ import annotations

import abc
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..kinematics import KinematicTree, skin_points
from .grids import CORNERS, PartGrids
from .hierarchical import SOFT_BLEND, hierarchical_softmax, num_logits
from .networks import ImplicitMLP, MLPShape
from .roles import fixed, learned, misshapen, stored

PAPER_SKINNING = MLPShape(width=128, depth=5, octaves=0, skip=(), condition_at=())
"""The paper's skinning network: five layers of 128, points as they are."""


class AbstractSkinningField(eqx.Module):
    """Maps one canonical point to non-negative weights that sum to one over the bones."""

    @abc.abstractmethod
    def __call__(self, x_c: Float[Array, "3"]) -> Float[Array, " J"]:
        """Weights at `x_c` (metres, canonical space)."""

    @abc.abstractmethod
    def covers(self, x_c: Float[Array, "3"]) -> Array:
        """Whether the field is meant to be used at `x_c`; a root elsewhere is not one."""


class MLPSkinning(AbstractSkinningField):
    """The paper's field: an MLP and the hierarchical softmax (X-Avatar, section 3.2)."""

    mlp: ImplicitMLP
    tree: KinematicTree = eqx.field(static=True)
    soft_blend: float = eqx.field(static=True)

    def __init__(
        self,
        tree: KinematicTree,
        shape: MLPShape = PAPER_SKINNING,
        *,
        soft_blend: float = SOFT_BLEND,
        key: PRNGKeyArray,
    ):
        self.mlp = ImplicitMLP(shape, outputs=num_logits(tree), key=key)
        self.tree = tree
        self.soft_blend = soft_blend

    def __call__(self, x_c: Float[Array, "3"]) -> Float[Array, " J"]:
        logits = self.mlp(x_c)
        return hierarchical_softmax(self.tree, self.soft_blend * logits)

    def covers(self, x_c: Float[Array, "3"]) -> Array:
        return jnp.all(jnp.isfinite(x_c))


class GridSkinning(AbstractSkinningField):
    """Logits of a template on part grids plus a learned, coarser correction.

    Near a joint the logits rise almost linearly along the limb, so what distinguishes one person's
    joints from the mean shape's is a slowly varying offset: the correction needs few nodes.
    """

    template: Float[Array, "N L"] = fixed()
    correction: Float[Array, "M L"] = learned()
    grids: PartGrids = fixed()
    correction_grids: PartGrids = stored()
    tree: KinematicTree = eqx.field(static=True)  # pyright: ignore[reportGeneralTypeIssues]

    def __call__(self, x_c: Float[Array, "3"]) -> Float[Array, " J"]:
        base = self.grids.interpolate(jax.lax.stop_gradient(self.template), x_c)
        offset = self.correction_grids.interpolate(self.correction, x_c)
        return hierarchical_softmax(self.tree, base + offset)

    def covers(self, x_c: Float[Array, "3"]) -> Array:
        return self.grids.covers(x_c)

    def faults(self) -> Iterator[tuple[str, str]]:
        """Leaves that do not fit one another: see `check_model`."""
        logits = num_logits(self.tree)
        yield from misshapen(self, template=(self.grids.num_nodes, logits))
        yield from misshapen(self, correction=(self.correction_grids.num_nodes, logits))


class TabulatedSkinning(AbstractSkinningField):
    """Weights on the nodes of part grids, read trilinearly.

    The accelerator of the search, and a field in its own right. Made from any other field by
    `tabulate`.
    """

    node_weights: Float[Array, "N J"]
    grids: PartGrids = stored()

    def __call__(self, x_c: Float[Array, "3"]) -> Float[Array, " J"]:
        return self.grids.interpolate(self.node_weights, x_c)

    def covers(self, x_c: Float[Array, "3"]) -> Array:
        return self.grids.covers(x_c)


class PosedGrid(eqx.Module):
    """Blended transforms of one frame on grid nodes: twelve numbers a lookup instead of J.

    Interpolating blended transforms equals blending with interpolated weights, since blending is
    linear (Fast-SNARF, Chen et al., 2023).
    """

    node_transforms: Float[Array, "N 12"]
    grids: PartGrids

    def __call__(self, x_c: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """The posed point and the exact Jacobian of the interpolated map."""
        cell, u, spacing = self.grids.locate(x_c)
        corners = self.node_transforms[self.grids.cells[cell]].reshape(8, 3, 4)
        # Corner by corner and axis by axis: a compiler turns this into vector code over points;
        # the same sums as reductions over small axes are several times slower.
        x, y, z = ((1 - u[k], u[k]) for k in range(3))
        posed, linear, turn = [], [], [[], [], []]
        for k, (i, j, l) in enumerate(CORNERS.tolist()):
            c = corners[k]
            carried = c[:, 0] * x_c[0] + c[:, 1] * x_c[1] + c[:, 2] * x_c[2] + c[:, 3]
            weight = x[i] * y[j] * z[l]
            posed.append(weight * carried)
            linear.append(weight * c[:, :3])
            for axis, slope in enumerate((y[j] * z[l], x[i] * z[l], x[i] * y[j])):
                turn[axis].append((1 if (i, j, l)[axis] else -1) * slope * carried)
        slope = jnp.stack([_total(terms) for terms in turn], axis=-1) / spacing
        return _total(posed), _total(linear) + slope


def _total(terms: list[Array]) -> Array:
    return sum(terms[1:], terms[0])


def tabulate(
    field: AbstractSkinningField, grids: PartGrids, *, chunk: int = 8192
) -> TabulatedSkinning:
    """Read a field at every node, `chunk` nodes at a time, continuous across grid borders."""
    nodes = grids.nodes
    padding = -len(nodes) % chunk
    padded = jnp.concatenate([nodes, jnp.broadcast_to(nodes[:1], (padding, 3))])
    weights = jax.lax.map(jax.vmap(field), padded.reshape(-1, chunk, 3))
    weights = weights.reshape(len(padded), -1)[: len(nodes)]
    return TabulatedSkinning(grids.blend(weights), grids)


def pose_grid(field: TabulatedSkinning, transforms: Float[Array, "J 4 4"]) -> PosedGrid:
    """Blend the bone transforms of one frame at every node."""
    flat = transforms[:, :3, :].reshape(transforms.shape[0], 12)
    return PosedGrid(
        jnp.matmul(field.node_weights, flat, precision=jax.lax.Precision.HIGHEST), field.grids
    )


def skin_with_jacobian(
    field: AbstractSkinningField, x_c: Float[Array, "3"], transforms: Float[Array, "J 4 4"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, " J"]]:
    """Posed point, its Jacobian with respect to `x_c` (X-Avatar, eq. 1) and the weights used."""

    def skin(x: Array) -> tuple[Array, tuple[Array, Array]]:
        weights = field(x)
        posed = skin_points(x, weights, transforms)
        return posed, (posed, weights)

    jacobian, (posed, weights) = jax.jacfwd(skin, has_aux=True)(x_c)
    return posed, jacobian, weights
