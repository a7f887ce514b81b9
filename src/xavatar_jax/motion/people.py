"""Choosing one person of a file that holds several."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path


def choose_person(counts: Mapping[int, int], person: int | None, where: str | Path) -> int:
    """The person asked for, or the only one.

    Args:
        counts: number of frames of each person.
        person: the one asked for, None if the caller did not say.
        where: file, for messages.

    Raises:
        ValueError: there is no such person, or there are several and none was asked for.
    """
    listed = ", ".join(f"{key} ({count} frames)" for key, count in sorted(counts.items()))
    if not counts:
        raise ValueError(f"{where}: nobody in it.")
    if person is not None:
        if person not in counts:
            raise ValueError(f"{where}: no person {person}; there are {listed}.")
        return person
    if len(counts) > 1:
        raise ValueError(f"{where}: {len(counts)} people: {listed}. Choose one with person=.")
    return next(iter(counts))
