"""The ablations of X-Avatar (table 1) as functions of a config, each changing one thing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

from .config import FitConfig


def body_starts(config: FitConfig) -> FitConfig:
    """A1: the search of every point starts at the body's bones."""
    return replace(config, search=replace(config.search, starts="body"))


def all_starts(config: FitConfig) -> FitConfig:
    """A2: the search of every point starts at all bones; points are drawn by part as before."""
    return replace(config, search=replace(config.search, starts="all_bones"))


def uniform_sampling(config: FitConfig) -> FitConfig:
    """A3: as many points, drawn from the whole surface regardless of part; starts by part."""
    return replace(config, points=replace(config.points, uniform=True))


def no_surface_term(config: FitConfig) -> FitConfig:
    """A4: nothing holds the weights at the surface; the term at the joints stays."""
    return replace(config, losses=replace(config.losses, surface=0.0))


ABLATIONS: Mapping[str, Callable[[FitConfig], FitConfig]] = MappingProxyType(
    {"A1": body_starts, "A2": all_starts, "A3": uniform_sampling, "A4": no_surface_term}
)
"""The paper's ablations by name: each gives a config with that one thing changed."""
