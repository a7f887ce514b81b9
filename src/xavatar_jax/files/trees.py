"""Arrays of a pytree in one `.npz`, by their path in the tree, with a JSON header. No pickles."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from .._version import __version__
from .archives import load_npz, parse_json
from .atomic import atomic_path

HEADER = "header.json"
T = TypeVar("T")


def save_arrays(
    path: str | os.PathLike[str], arrays: Mapping[str, Any], header: Mapping[str, Any]
) -> None:
    """Write arrays and a header of plain JSON values, under a temporary name first."""
    encoded = np.frombuffer(json.dumps(dict(header)).encode(), np.uint8)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        named: dict[str, Any] = {k: np.asarray(v) for k, v in arrays.items()}
        np.savez(file, allow_pickle=False, **{HEADER: encoded}, **named)


def load_arrays(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `save_arrays` wrote: arrays by name, and the header.

    **Raises:** `ValueError` naming the file and the entry if it was not written by `save_arrays`,
    or is damaged.
    """
    entries = load_npz(path)
    header = _pop_header(path, entries)
    for name, value in entries.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind == "O":
            raise ValueError(f"{os.fspath(path)}: {name} holds Python objects, expected an array")
    return entries, header


def load_header(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The header of what `save_arrays` wrote, without reading the arrays.

    **Raises:** as `load_arrays`.
    """
    return _pop_header(path, load_npz(path, only=HEADER))


def _pop_header(path: str | os.PathLike[str], entries: dict[str, Any]) -> dict[str, Any]:
    name = os.fspath(path)
    if HEADER not in entries:
        raise ValueError(f"{name}: no {HEADER} inside, so xavatar_jax did not write it")
    encoded = entries.pop(HEADER)
    if not isinstance(encoded, np.ndarray) or encoded.dtype != np.uint8 or encoded.ndim != 1:
        raise ValueError(f"{name}: {HEADER} is no array of bytes")
    header = parse_json(encoded.tobytes(), f"{name}, {HEADER}")
    if not isinstance(header, dict):
        raise ValueError(f"{name}: {HEADER} holds a {type(header).__name__}, expected an object")
    return header


_KINDS = {int: "a whole number", float: "a number", str: "text", dict: "an object", list: "a list"}


def header_entry(
    path: str | os.PathLike[str], header: Mapping[str, Any], name: str, kind: type[T]
) -> T:
    """An entry of a header, whose type is checked.

    Args:
        path: the file, for messages.
        header: what `load_header` gave.
        name: of the entry; `body.path` is the entry `path` of the entry `body`.
        kind: `int`, `float`, `str`, `dict` or `list`; whole numbers are floats, too.

    **Raises:** `ValueError` naming file and entry if it is missing or of another type.
    """
    value: Any = header
    for part in name.split("."):
        if not isinstance(value, Mapping) or part not in value:
            raise ValueError(f"{os.fspath(path)}: the header has no entry {name!r}")
        value = value[part]
    accepted = (int, float) if kind is float else kind
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(
            f"{os.fspath(path)}: the header's entry {name!r} is {str(value)[:40]!r}, expected "
            f"{_KINDS.get(kind, kind.__name__)}"
        )
    return value  # type: ignore[return-value]


def refuse_newer(
    path: str | os.PathLike[str], header: Mapping[str, Any], known: int, *, written_by: str
) -> None:
    """**Raises:** `ValueError` unless the header's `format` is a whole number up to `known`, the
    newest that this version reads."""
    found = header_entry(path, header, "format", int)
    if found > known:
        raise ValueError(
            f"{os.fspath(path)}: written by xavatar_jax {written_by} in format {found}; this "
            f"version ({__version__}) reads up to {known}"
        )


def flatten_named(tree: Any) -> dict[str, Any]:
    """Array leaves of a pytree by their path, `.field[0].name` style."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}


def unflatten_named(like: Any, arrays: Mapping[str, np.ndarray], *, source: str) -> Any:
    """`like` with its array leaves replaced by those of the same path.

    **Raises:** `ValueError` naming `source`, the leaf and both shapes, if one is missing, has
    another shape, or holds no numbers.
    """

    def replace(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path).lstrip(".")
        if name not in arrays:
            raise ValueError(f"{source}: no array {name!r}")
        value = arrays[name]
        if value.shape != leaf.shape:
            raise ValueError(f"{source}: {name} has shape {value.shape}, expected {leaf.shape}")
        if value.dtype.kind not in "biufc":
            raise ValueError(f"{source}: {name} holds {value.dtype}, expected numbers")
        return jax.numpy.asarray(value, leaf.dtype)

    return jax.tree_util.tree_map_with_path(replace, like)
