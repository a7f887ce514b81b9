"""What a method gives: an avatar, and how it was learned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ..avatar import Drivable
from ..frames import Frames
from ..learning import History


@dataclass(frozen=True, eq=False)
class Fit:
    """A learned avatar. Unpacks to `avatar, history`.

    - `before`: the avatar at step 0, or None if the method has none.
    - `frames`: the training frames that were learned from.
    """

    avatar: Drivable
    history: History
    before: Drivable | None
    frames: Frames

    def __iter__(self) -> Iterator[Any]:
        return iter((self.avatar, self.history))
