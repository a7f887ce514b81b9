"""A step on several devices: each takes a part of the batch, all hold the same model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import gcd
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

BY_FRAME = PartitionSpec("frames")
"""Divides a leaf of a batch by its first axis."""
BY_POINT = PartitionSpec("frames", "points")
"""Divides a leaf of a batch by its first two axes."""
WHOLE = PartitionSpec()


@dataclass(frozen=True)
class Devices:
    """The devices of a step: a mesh with the axes frames and points, or None for one device."""

    mesh: Mesh | None = None

    def replicate(self, tree: Any) -> Any:
        """The tree with its arrays on every device."""
        if self.mesh is None:
            return tree
        everywhere = NamedSharding(self.mesh, WHOLE)

        def put(leaf: Any) -> Any:
            if not eqx.is_array(leaf) or getattr(leaf, "sharding", None) == everywhere:
                return leaf
            # Through the host: with several hosts each has its own copy of the same values.
            return jax.device_put(np.asarray(leaf), everywhere)

        return jax.tree.map(put, tree)

    def collect(self, tree: Any) -> Any:
        """The tree with its arrays on the first local device alone."""
        if self.mesh is None:
            return tree
        return jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf)) if eqx.is_array(leaf) else leaf, tree
        )

    def divide(self, tree: Any, specs: Any) -> Any:
        """Inside jit: the tree divided among the devices, by a tree of `BY_FRAME`, `BY_POINT`."""
        if self.mesh is None:
            return tree
        mesh = self.mesh
        return jax.tree.map(
            lambda leaf, spec: jax.lax.with_sharding_constraint(leaf, NamedSharding(mesh, spec)),
            tree,
            specs,
        )

    def whole(self, tree: Any) -> Any:
        """Inside jit: the tree on every device."""
        if self.mesh is None:
            return tree
        return jax.lax.with_sharding_constraint(tree, NamedSharding(self.mesh, WHOLE))

    def apart(self, function: Callable[..., Any], model: Any, tree: Any, specs: Any) -> Any:
        """`function(model, tree)` with each device on its own part, without communication.

        For loops that end with their last lane: on a divided array, every device would wait for
        the slowest. The result is divided by frames and points, and has no derivative.
        """
        if self.mesh is None:
            return function(model, tree)
        arrays, static = eqx.partition(model, eqx.is_array)
        arrays, tree = jax.lax.stop_gradient((arrays, tree))
        own = jax.shard_map(
            lambda arrays, tree: function(eqx.combine(arrays, static), tree),
            mesh=self.mesh,
            in_specs=(WHOLE, specs),
            out_specs=BY_POINT,
            check_vma=False,
        )
        return own(arrays, tree)

    def agree(self, flag: bool) -> bool:
        """Whether the flag is set in any process. Every process has to call this."""
        return bool(np.any(_of_every_process(flag)))

    def least(self, number: int) -> int:
        """The smallest number of all processes. Every process has to call this."""
        return int(np.min(_of_every_process(number)))

    @property
    def first(self) -> Any:
        """The first of the devices."""
        return jax.devices()[0] if self.mesh is None else self.mesh.devices.flat[0]

    @property
    def count(self) -> int:
        """How many devices there are."""
        return 1 if self.mesh is None else self.mesh.size


ONE_DEVICE = Devices()
"""Steps run on the default device."""


def _of_every_process(value: Any) -> np.ndarray:
    if jax.process_count() == 1:
        return np.asarray(value)
    from jax.experimental.multihost_utils import process_allgather

    return np.asarray(process_allgather(np.asarray(value)))


def share_work(
    frames: int, points: Mapping[str, int], devices: Sequence[Any] | None = None
) -> Devices:
    """Divide a step of `frames` a batch among devices (default: all that JAX sees, of every host).

    Each device takes some of the frames; if there are more devices than frames, some of the points
    of a frame. `points`: the counts a frame that must divide evenly, by the name of their option.

    **Raises:** `ValueError` if the batch cannot be divided evenly.
    """
    chosen = list(jax.devices() if devices is None else devices)
    if chosen == jax.devices()[:1]:
        return ONE_DEVICE
    rows = gcd(frames, len(chosen))
    columns = len(chosen) // rows
    for name, count in points.items():
        if count % columns:
            raise ValueError(
                f"{frames} frames of {count} points a step cannot be divided among "
                f"{len(chosen)} devices: let frames_per_step be a multiple of {len(chosen)}, or "
                f"{name} one of {columns}, or pass fewer devices"
            )
    return Devices(Mesh(np.asarray(chosen).reshape(rows, columns), ("frames", "points")))
