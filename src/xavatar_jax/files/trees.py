"""Arrays of a pytree in one `.npz`, by their path in the tree, with a JSON header. No pickle."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from .._version import __version__
from .atomic import atomic_path
from .unpickle import load_npz

HEADER = "header.json"


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

    **Raises:** `ValueError` naming the file if it was not written by `save_arrays`.
    """
    entries = load_npz(path)
    return entries, _pop_header(path, entries)


def load_header(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The header of what `save_arrays` wrote, without reading the arrays.

    **Raises:** as `load_arrays`.
    """
    return _pop_header(path, load_npz(path, only=HEADER))


def _pop_header(path: str | os.PathLike[str], entries: dict[str, Any]) -> dict[str, Any]:
    if HEADER not in entries:
        raise ValueError(f"{os.fspath(path)}: no {HEADER} inside, so it is not one of our files")
    return json.loads(bytes(entries.pop(HEADER)).decode())


def refuse_newer(
    path: str | os.PathLike[str], header: Mapping[str, Any], known: int, *, written_by: str
) -> None:
    """**Raises:** `ValueError` if the header's `format` is above `known`, the newest we read."""
    if header["format"] > known:
        raise ValueError(
            f"{os.fspath(path)}: written by xavatar_jax {written_by} in format "
            f"{header['format']}; this version ({__version__}) reads up to {known}"
        )


def flatten_named(tree: Any) -> dict[str, Any]:
    """Array leaves of a pytree by their path, `.field[0].name` style."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}


def unflatten_named(like: Any, arrays: Mapping[str, np.ndarray], *, source: str) -> Any:
    """`like` with its array leaves replaced by those of the same path.

    **Raises:** `ValueError` naming `source`, the leaf and both shapes, if one is missing or has
    another shape.
    """

    def replace(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path).lstrip(".")
        if name not in arrays:
            raise ValueError(f"{source}: no array {name!r}")
        value = arrays[name]
        if value.shape != leaf.shape:
            raise ValueError(f"{source}: {name} has shape {value.shape}, expected {leaf.shape}")
        return jax.numpy.asarray(value, leaf.dtype)

    return jax.tree_util.tree_map_with_path(replace, like)
