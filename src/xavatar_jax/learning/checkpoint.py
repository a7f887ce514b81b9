"""Checkpoints: a run in one file of named arrays with a JSON header, without pickle."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._version import __version__
from ..files import flatten_named, load_arrays, refuse_newer, save_arrays, unflatten_named
from .devices import Devices
from .record import History
from .stage import TrainState
from .stopping import notify
from .validation import Best

_FORMAT = 4


@dataclass(frozen=True)
class Identity:
    """What makes two runs the same. A checkpoint of another run is refused.

    - `parts`: checksums by the word that an error names them by, such as `{"frames": "3f..."}`.
    - `options`: the run's options as nested plain values; `free`: dotted names of those that may
      differ when a run is resumed, such as its number of steps.
    """

    parts: Mapping[str, str]
    options: dict[str, Any]
    free: tuple[str, ...] = ()


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as it was read."""

    path: str
    arrays: dict[str, np.ndarray]
    header: dict[str, Any]

    @property
    def step(self) -> int:
        """Steps done."""
        return self.header["step"]

    @property
    def options(self) -> dict[str, Any]:
        """The options of the run when the checkpoint was written."""
        return self.header["run"]["options"]

    def history(self) -> History:
        """The history until then."""
        return History(**self.header["history"])

    def state(self, like: TrainState) -> TrainState:
        """The state, with the structure of `like`."""
        return unflatten_named(like, self.part("state"), source=self.path)

    def best(self, like: Any) -> Best:
        """The best model so far, with the structure of the learned leaves `like`."""
        saved = self.part("best")
        learned = unflatten_named(like, saved, source=self.path) if saved else None
        return Best(learned=learned, **self.header["best"])

    def part(self, prefix: str) -> dict[str, np.ndarray]:
        """The arrays of one part by name: "data" holds what `Keeper.kept` chose."""
        start = f"{prefix}:"
        return {
            name.removeprefix(start): value
            for name, value in self.arrays.items()
            if name.startswith(start)
        }


@dataclass(frozen=True)
class Keeper:
    """The checkpoint file of a run.

    - `saved`: the checkpoint that the run resumes from, if any.
    - `kept`: the part of the data to store: whatever the run changes and cannot make again.
    """

    path: Path
    identity: Identity
    saved: Checkpoint | None = None
    kept: Callable[[Any], Any] = lambda data: None

    def save(
        self,
        state: TrainState,
        best: Best,
        history: History,
        data: Any,
        latest: Mapping[str, float],
        devices: Devices,
    ) -> None:
        """Write the run under a temporary name, then rename."""
        arrays = _prefixed("state", state)
        if best.learned is not None:
            arrays |= _prefixed("best", best.learned)
        arrays |= _prefixed("data", eqx.filter(self.kept(data), eqx.is_array))
        header = {
            "kind": "checkpoint",
            "format": _FORMAT,
            "step": int(state.step),
            "run": {"parts": dict(self.identity.parts), "options": self.identity.options},
            "best": best.to_dict(),
            "history": history.to_dict(),
            "latest": dict(latest),
            "versions": _versions(devices),
        }
        save_arrays(self.path, arrays, header)


def load_checkpoint(
    path: str | os.PathLike[str],
    identity: Identity,
    devices: Devices,
    notices: list[str] | None = None,
) -> Checkpoint:
    """Read a checkpoint of this run.

    **Raises:** `FileNotFoundError`; `ValueError` naming the file if it is damaged, not a
    checkpoint, from another version's format, or of another run, and then what differs.
    **Warns:** `TrainingNotice` if versions or devices differ, because numbers may then differ.
    """
    name = os.fspath(path)
    if not Path(path).exists():
        raise FileNotFoundError(f"no checkpoint at {name}")
    arrays, header = load_arrays(path)
    check_header(path, header)
    run = header["run"]
    for part, value in identity.parts.items():
        if run["parts"].get(part) != value:
            raise ValueError(
                f"{name}: the checkpoint of a run on other {part}; start again without resuming"
            )
    changed = [
        f"{entry} ({old!r}, now {new!r})"
        for entry, old, new in _differences(_plain(run["options"]), _plain(identity.options))
        if entry not in identity.free
    ]
    if changed:
        raise ValueError(
            f"{name}: the checkpoint of a run with other options: {', '.join(changed)}. A resumed "
            f"run may change only {', '.join(identity.free) or 'nothing'}"
        )
    versions = _versions(devices)
    other = [
        f"{what} {old} (now {versions.get(what)})"
        for what, old in header["versions"].items()
        if versions.get(what) != old
    ]
    if other:
        notify(
            f"{name}: written with {', '.join(other)}. The run continues, but its numbers may "
            "differ in their last digits from those of an uninterrupted one.",
            notices,
            stacklevel=3,
        )
    return Checkpoint(name, arrays, header)


def check_header(path: str | os.PathLike[str], header: Mapping[str, Any]) -> None:
    """**Raises:** `ValueError` unless it is the header of a checkpoint of this format."""
    name = os.fspath(path)
    if header.get("kind") != "checkpoint":
        raise ValueError(f"{name}: expected a checkpoint, found {header.get('kind', 'no kind')}")
    if not isinstance(header.get("format"), int):
        raise ValueError(f"{name}: header entry 'format' is {header.get('format')!r}, not a number")
    if header["format"] < _FORMAT:
        raise ValueError(
            f"{name}: a checkpoint of an older version (format {header['format']}, now "
            f"{_FORMAT}); start the run again"
        )
    refuse_newer(path, header, _FORMAT, written_by=header["versions"]["xavatar_jax"])


def _prefixed(prefix: str, tree: Any) -> dict[str, Any]:
    return {f"{prefix}:{name}": value for name, value in flatten_named(tree).items()}


def _plain(values: Any) -> Any:
    """Values as JSON gives them back: tuples are lists."""
    if isinstance(values, Mapping):
        return {name: _plain(value) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [_plain(value) for value in values]
    return values


def _differences(old: Any, new: Any, where: str = "") -> list[tuple[str, Any, Any]]:
    """Entries that differ between two nested dictionaries, by their dotted names."""
    if isinstance(old, dict) and isinstance(new, dict):
        found = []
        for name in {**old, **new}:
            path = f"{where}.{name}" if where else name
            found += _differences(old.get(name), new.get(name), path)
        return found
    return [] if old == new else [(where, old, new)]


def _versions(devices: Devices) -> dict[str, Any]:
    device = devices.first
    return {
        "xavatar_jax": __version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": f"{device.platform}: {device.device_kind}",
        "devices": devices.count,
    }


def as_arrays(saved: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The arrays of `Checkpoint.part` as JAX arrays."""
    return {name: jnp.asarray(value) for name, value in saved.items()}
