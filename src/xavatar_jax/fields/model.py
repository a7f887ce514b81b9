"""The fields of one avatar, and operations on all of their arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .color import AbstractColorField
from .geometry import AbstractGeometryField
from .link import AbstractLink, Occupancy
from .roles import stored_leaves
from .skinning import AbstractSkinningField


class AvatarModel(eqx.Module):
    """Skinning, geometry and, for some methods, colour in one canonical space.

    `link` tells what the geometry's level means.
    """

    skinning: AbstractSkinningField
    geometry: AbstractGeometryField
    link: AbstractLink = Occupancy()
    color: AbstractColorField | None = None


def check_model(model: AvatarModel) -> None:
    """Check that the arrays of a model fit one another, as those of a damaged file may not.

    Looks at every nested module with a method `faults`, which yields names of leaves and what is
    wrong with them, and at the values of all stored leaves. Not for use under `jit`.

    **Raises:** `ValueError` naming the leaf, the shape found and the shape expected.
    """
    for path, module in _modules(model, ""):
        for name, fault in getattr(module, "faults", lambda: ())():
            raise ValueError(f"{path}.{name}: {fault}".lstrip("."))
    stored = eqx.filter(model, stored_leaves(model))
    for path, leaf in jax.tree_util.tree_leaves_with_path(stored):
        name, values = jax.tree_util.keystr(path).lstrip("."), np.asarray(leaf)
        # Ranges are infinite until they are learned.
        allowed = ~np.isnan(values) if name.endswith("_range") else np.isfinite(values)
        if not allowed.all():
            where = tuple(int(i) for i in np.argwhere(~allowed)[0])
            raise ValueError(f"{name}: {values[where]} at {where} of shape {values.shape}")


def stack_models(models: Sequence[AvatarModel]) -> AvatarModel:
    """Models of several people as one, with a leading axis, to be vmapped over.

    Grids of different people have different numbers of nodes: arrays are padded with zeros at
    their ends, which no lookup reaches. Specs and body have to be the same.
    """

    def stack(*leaves: Array) -> Array:
        size = np.max([leaf.shape for leaf in leaves], axis=0)
        pad = [[(0, int(m - n)) for m, n in zip(size, leaf.shape, strict=True)] for leaf in leaves]
        return jnp.stack([jnp.pad(x, p) if p else x for x, p in zip(leaves, pad, strict=True)])

    return jax.tree.map(stack, *models)


def _modules(node: Any, path: str) -> Iterator[tuple[str, eqx.Module]]:
    """All modules in a tree with their paths, nested ones first."""
    nested = jax.tree_util.tree_leaves_with_path(
        node, is_leaf=lambda x: x is not node and isinstance(x, eqx.Module)
    )
    for key, child in nested:
        if isinstance(child, eqx.Module):
            yield from _modules(child, path + jax.tree_util.keystr(key))
    if isinstance(node, eqx.Module):
        yield path, node
