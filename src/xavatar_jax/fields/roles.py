"""Roles of a module's arrays: learned, stored with an avatar, or rebuilt from the body."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree

_ROLE = "xavatar_jax.role"
_FIXED, _STORED, _LEARNED = range(3)


def learned(**kwargs: Any) -> Any:
    """A dataclass field whose floating-point arrays are learned. This is the default."""
    return eqx.field(metadata={_ROLE: _LEARNED}, **kwargs)


def stored(**kwargs: Any) -> Any:
    """A dataclass field whose arrays are not learned, but kept in an avatar's file."""
    return eqx.field(metadata={_ROLE: _STORED}, **kwargs)


def fixed(**kwargs: Any) -> Any:
    """A dataclass field whose arrays are neither learned nor kept: the body determines them."""
    return eqx.field(metadata={_ROLE: _FIXED}, **kwargs)


def learned_leaves(module: PyTree) -> PyTree[bool]:
    """A tree of booleans like `module`: True for leaves that training may change."""
    return _leaves_of(module, _LEARNED)


def stored_leaves(module: PyTree) -> PyTree[bool]:
    """A tree of booleans like `module`: True for leaves that an avatar's file keeps.

    These are the learned ones and those that were declared `stored`.
    """
    return _leaves_of(module, _STORED)


def _leaves_of(module: PyTree, least: int) -> PyTree[bool]:
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: eqx.is_array(leaf) and _role(module, path, leaf) >= least, module
    )


def _role(node: Any, path: Any, leaf: Any) -> int:
    """The most restrictive role along a path: a holder's role covers what is nested in it.

    Without any declaration, floating-point arrays are learned and other arrays fixed.
    """
    found = []
    for key in path:
        if isinstance(node, eqx.Module):
            declared = {f.name: f.metadata.get(_ROLE) for f in fields(node)}
            found.append(declared.get(key.name))
        node = _child(node, key)
    found = [role for role in found if role is not None]
    default = _LEARNED if eqx.is_inexact_array(leaf) else _STORED if found else _FIXED
    return min([default, *found])


def _child(node: Any, key: Any) -> Any:
    if isinstance(key, jax.tree_util.GetAttrKey):
        return getattr(node, key.name)
    if isinstance(key, jax.tree_util.SequenceKey):
        return node[key.idx]
    if isinstance(key, jax.tree_util.DictKey):
        return node[key.key]
    return None  # a custom container: its leaves have the roles found so far


def misshapen(module: Any, **expected: tuple[int | None, ...]) -> Iterator[tuple[str, str]]:
    """Arrays of a module whose shape is not the one expected, where None stands for any size."""
    for name, wanted in expected.items():
        found = getattr(module, name).shape
        fits = len(found) == len(wanted) and all(
            n is None or m == n for m, n in zip(found, wanted, strict=True)
        )
        if not fits:
            sizes = ", ".join("any" if n is None else str(n) for n in wanted)
            yield name, f"shape {found}, expected ({sizes})"
