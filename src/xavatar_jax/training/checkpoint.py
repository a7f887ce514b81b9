"""A run in one file, from which it goes on: arrays by name and a JSON header, no pickle."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._version import __version__
from ..body import BodyModel, BodyParams
from ..files import flatten_named, load_arrays, refuse_newer, save_arrays, unflatten_named
from .check import notify
from .config import FitConfig, config_from_dict, config_to_dict
from .devices import Devices
from .history import History
from .pool import FramePool
from .step import TrainState
from .validation import Best

_FORMAT = 3
# What may change from one part of a run to the next: how long it is, and how large its steps are.
_FREE = (
    *("steps", "minutes", "report_every", "checkpoint_every", "validation.patience"),
    *(
        "validation.every",
        "validation.gain",
        "optimiser.learning_rate",
        "optimiser.skinning_rate",
        "optimiser.clip",
    ),
)


@dataclass(frozen=True)
class RunIdentity:
    """What a run is made of. A checkpoint of another one is refused.

    - `body`: checksum; `data`: checksum of the frames' parameters and the person's betas.
    - `versions`: of packages, and the devices. They may differ, and numbers with them.
    """

    body: str
    data: str
    config: dict[str, Any]
    versions: dict[str, Any]


def run_identity(
    body: BodyModel, params: BodyParams, betas: Any, config: FitConfig, devices: Devices
) -> RunIdentity:
    """The identity of a run on frames with these parameters."""
    digest = hashlib.sha256()
    for values in (params.pose, params.expression, params.transl, betas):
        digest.update(np.ascontiguousarray(values).tobytes())
    return RunIdentity(
        body.source.checksum, digest.hexdigest(), config_to_dict(config), _versions(devices)
    )


def save_checkpoint(
    path: str | os.PathLike[str],
    identity: RunIdentity,
    state: TrainState,
    best: Best,
    history: History,
    pool: FramePool | None,
    latest: Mapping[str, float],
) -> None:
    """Write a run's state. `pool`: where roots are stored, since they follow the fields."""
    arrays = _prefixed("state", flatten_named(state))
    if best.learned is not None:
        arrays |= _prefixed("best", flatten_named(best.learned))
    if pool is not None:
        arrays |= _prefixed("pool", _pool_arrays(pool))
    header = {
        "kind": "checkpoint",
        "format": _FORMAT,
        "step": int(state.step),
        "run": {"body": identity.body, "data": identity.data, "config": identity.config},
        "best": best.to_dict(),
        "history": history.to_dict(),
        "latest": dict(latest),
        "versions": identity.versions,
    }
    save_arrays(path, arrays, header)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as read: `state` and `best` are made by the run that goes on."""

    path: str
    arrays: dict[str, np.ndarray]
    header: dict[str, Any]

    @property
    def step(self) -> int:
        return self.header["step"]

    @property
    def budget(self) -> tuple[int, float | None]:
        """Steps and minutes of the run's last part."""
        config = self.header["run"]["config"]
        return config["steps"], config["minutes"]

    @property
    def latest(self) -> dict[str, float]:
        return self.header["latest"]

    def history(self) -> History:
        return History(**self.header["history"])

    def state(self, like: TrainState) -> TrainState:
        """The saved state, in the form of a fresh one."""
        return unflatten_named(like, self._part("state"), source=self.path)

    def best(self, like: Any) -> Best:
        """The best fields so far, in the form of a state's learned ones."""
        saved = self._part("best")
        learned = unflatten_named(like, saved, source=self.path) if saved else None
        return Best(**self.header["best"], learned=learned)

    def pool(self, params: BodyParams) -> FramePool | None:
        """The saved points of frames with these parameters, or None if there are none."""
        saved = self._part("pool")
        if not saved:
            return None
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)
        arrays = {name: jnp.asarray(value) for name, value in saved.items()}
        return FramePool(params=params, **arrays)

    def _part(self, prefix: str) -> dict[str, np.ndarray]:
        start = f"{prefix}:"
        return {
            name.removeprefix(start): value
            for name, value in self.arrays.items()
            if name.startswith(start)
        }


def load_checkpoint(
    path: str | os.PathLike[str], identity: RunIdentity, notices: list[str] | None = None
) -> Checkpoint:
    """Read a checkpoint of this run.

    **Raises:** `FileNotFoundError`; `ValueError` naming the file if it is damaged, no checkpoint,
    from a newer version, or of another run, and then what differs.
    **Warns:** `TrainingNotice` where versions or devices differ: then numbers may, too. The
    message is added to `notices`.
    """
    name = os.fspath(path)
    if not Path(path).exists():
        raise FileNotFoundError(f"no checkpoint at {name}")
    arrays, header = load_arrays(path)
    check_header(path, header)
    run = header["run"]
    for part, found, wanted in (
        ("body", run["body"], identity.body),
        ("frames", run["data"], identity.data),
    ):
        if found != wanted:
            raise ValueError(f"{name}: a checkpoint of a run on other {part}; begin without it")
    saved_config = config_to_dict(config_from_dict(run["config"]))
    changed = [
        f"{entry} ({old!r}, now {new!r})"
        for entry, old, new in _differences(saved_config, identity.config)
        if entry not in _FREE
    ]
    if changed:
        raise ValueError(
            f"{name}: a checkpoint of a run with another config: {', '.join(changed)}. Only "
            f"{', '.join(_FREE)} may change when a run goes on"
        )
    other = [
        f"{what} {old} (now {identity.versions.get(what)})"
        for what, old in header["versions"].items()
        if identity.versions.get(what) != old
    ]
    if other:
        notify(
            f"{name}: written with {', '.join(other)}. The run goes on, but its numbers may "
            "differ in their last digits from those of an uninterrupted one.",
            notices,
            stacklevel=3,
        )
    return Checkpoint(name, arrays, header)


def check_header(path: str | os.PathLike[str], header: Mapping[str, Any]) -> None:
    """**Raises:** `ValueError` unless it is the header of a checkpoint that we can read."""
    if header.get("kind") != "checkpoint":
        kind = header.get("kind", "something else")
        raise ValueError(f"{os.fspath(path)}: not a checkpoint, but {kind}")
    if header["format"] < _FORMAT:
        raise ValueError(
            f"{os.fspath(path)}: a checkpoint of an older version (format {header['format']}, now "
            f"{_FORMAT}); begin the run anew"
        )
    refuse_newer(path, header, _FORMAT, written_by=header["versions"]["xavatar_jax"])


@dataclass(frozen=True)
class Keeper:
    """A run's checkpoint file: what it was read as, if the run goes on, and how it is written."""

    path: Path
    identity: RunIdentity
    saved: Checkpoint | None = None

    def save(self, *state: Any) -> None:
        """See `save_checkpoint`."""
        save_checkpoint(self.path, self.identity, *state)


def _differences(old: Any, new: Any, where: str = "") -> list[tuple[str, Any, Any]]:
    """Entries that differ between two nested dictionaries, by their path."""
    if isinstance(old, dict) and isinstance(new, dict):
        found = []
        for name in {**old, **new}:
            path = f"{where}.{name}" if where else name
            found += _differences(old.get(name), new.get(name), path)
        return found
    return [] if old == new else [(where, old, new)]


def _prefixed(prefix: str, arrays: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{prefix}:{name}": value for name, value in arrays.items()}


def _pool_arrays(pool: FramePool) -> dict[str, Any]:
    """Arrays of a pool by field; the parameters come from the frames again."""
    return {
        f.name: getattr(pool, f.name)
        for f in fields(pool)
        if f.name != "params" and eqx.is_array(getattr(pool, f.name))
    }


def _versions(devices: Devices) -> dict[str, Any]:
    device = devices.first
    return {
        "xavatar_jax": __version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": f"{device.platform}: {device.device_kind}",
        "devices": devices.count,
    }
