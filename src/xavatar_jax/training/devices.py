"""A step on many devices: each takes some frames of the batch, all have the same fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import gcd
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from .batch import Batch
from .config import FitConfig

_BY_FRAME, _BY_POINT = PartitionSpec("frames"), PartitionSpec("frames", "points")
_WHOLE = PartitionSpec()
_POINT_LEAVES = ("points", "parts", "distance", "root", "rooted")


@dataclass(frozen=True)
class Devices:
    """Where a step runs: a mesh with the axes frames and points, or None for one device."""

    mesh: Mesh | None = None

    def replicate(self, tree: Any) -> Any:
        """The tree with its arrays on every device."""
        if self.mesh is None:
            return tree
        everywhere = NamedSharding(self.mesh, _WHOLE)
        # By way of the host: with several hosts each has its own copy of the same values.
        return jax.tree.map(
            lambda leaf: (
                jax.device_put(np.asarray(leaf), everywhere) if eqx.is_array(leaf) else leaf
            ),
            tree,
        )

    def collect(self, tree: Any) -> Any:
        """The tree with its arrays on the first local device alone."""
        if self.mesh is None:
            return tree
        return jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf)) if eqx.is_array(leaf) else leaf, tree
        )

    def spread(self, batch: Batch) -> Batch:
        """Inside a jitted step: the batch divided among the devices."""
        if self.mesh is None:
            return batch
        mesh = self.mesh

        def place(leaf: Array, spec: PartitionSpec) -> Array:
            return jax.lax.with_sharding_constraint(leaf, NamedSharding(mesh, spec))

        return jax.tree.map(place, batch, _specs(batch))

    def whole(self, tree: Any) -> Any:
        """Inside a jitted step: the tree on every device, as the next step wants it."""
        if self.mesh is None:
            return tree
        return jax.lax.with_sharding_constraint(tree, NamedSharding(self.mesh, _WHOLE))

    def apart(self, search: Callable[..., Any], fields: Any, batch: Batch) -> Any:
        """`search(fields, batch)` with each device on its own points and no word between them.

        A search loops until its last lane has ended: shared, every device would wait for the
        slowest, and lanes would travel.
        """
        if self.mesh is None:
            return search(fields, batch)
        arrays, static = eqx.partition(fields, eqx.is_array)
        # A search is never differentiated, and its loop could not be.
        arrays, batch = jax.lax.stop_gradient((arrays, batch))
        own = jax.shard_map(
            lambda arrays, batch: search(eqx.combine(arrays, static), batch),
            mesh=self.mesh,
            in_specs=(_WHOLE, _specs(batch)),
            out_specs=_BY_POINT,
            check_vma=False,
        )
        return own(arrays, batch)

    def agree(self, flag: bool) -> bool:
        """Whether the flag is up in any process; every process has to ask."""
        return bool(np.any(_of_every_process(flag)))

    def least(self, number: int) -> int:
        """The least of the numbers of all processes; every process has to ask."""
        return int(np.min(_of_every_process(number)))

    @property
    def first(self) -> Any:
        return jax.devices()[0] if self.mesh is None else self.mesh.devices.flat[0]

    @property
    def count(self) -> int:
        return 1 if self.mesh is None else self.mesh.size


ONE_DEVICE = Devices()


def _of_every_process(value: Any) -> np.ndarray:
    """The values of all processes, each of which has to ask."""
    if jax.process_count() == 1:
        return np.asarray(value)
    from jax.experimental.multihost_utils import process_allgather

    return np.asarray(process_allgather(np.asarray(value)))


def _specs(batch: Batch) -> Batch:
    """How each leaf of a batch is divided."""
    by_frame = jax.tree.map(lambda _: _BY_FRAME, batch)
    return by_frame._replace(**dict.fromkeys(_POINT_LEAVES, _BY_POINT))


def share_work(config: FitConfig, devices: Sequence[Any] | None = None) -> Devices:
    """Divide a step among devices (default: all that JAX sees, of every host).

    Each takes some of the frames of a batch; where there are more devices than frames, some of
    the points of a frame.

    **Raises:** `ValueError` if the batch cannot be divided evenly.
    """
    chosen = list(jax.devices() if devices is None else devices)
    if chosen == jax.devices()[:1]:
        return ONE_DEVICE
    rows = gcd(config.frames_per_step, len(chosen))
    columns = len(chosen) // rows
    counts = {"points_per_step": config.points_per_step}
    if config.search.cached:
        counts["skinning_points"] = config.skinning_points
    for name, count in counts.items():
        if count % columns:
            raise ValueError(
                f"{config.frames_per_step} frames of {count} points a step cannot be divided "
                f"among {len(chosen)} devices: let frames_per_step be a multiple of "
                f"{len(chosen)}, or {name} one of {columns}, or pass fewer devices"
            )
    return Devices(Mesh(np.asarray(chosen).reshape(rows, columns), ("frames", "points")))
