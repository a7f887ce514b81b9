"""Joint names and parents, static under `jit`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class KinematicTree:
    """Joint names and parent indices, hashable. The root comes first, with parent -1.

    **Raises:** `ValueError` if a parent does not come before its child, names repeat, or there is
    not exactly one root.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.parents):
            raise ValueError(f"{len(self.names)} joint names but {len(self.parents)} parents")
        if len(set(self.names)) != len(self.names):
            repeated = sorted({n for n in self.names if self.names.count(n) > 1})
            raise ValueError(f"joint names repeat: {repeated}")
        if not self.parents or self.parents[0] != -1:
            raise ValueError("the first joint must be the root, with parent -1")
        for joint, parent in enumerate(self.parents[1:], start=1):
            if not 0 <= parent < joint:
                raise ValueError(
                    f"joint {joint} ({self.names[joint]}) has parent {parent}; "
                    f"parents must come before their children, and only joint 0 is a root"
                )

    @property
    def num_joints(self) -> int:
        """J, the number of joints."""
        return len(self.parents)

    @cached_property
    def levels(self) -> tuple[tuple[int, ...], ...]:
        """Joints grouped by their depth in the tree."""
        depth = [0] * self.num_joints
        for joint, parent in enumerate(self.parents[1:], start=1):
            depth[joint] = depth[parent] + 1
        return tuple(
            tuple(j for j in range(self.num_joints) if depth[j] == d) for d in range(max(depth) + 1)
        )

    def children(self, joint: int) -> tuple[int, ...]:
        """The joints with this parent, in index order."""
        return tuple(k for k, parent in enumerate(self.parents) if parent == joint)

    def subtree(self, joint: int) -> tuple[int, ...]:
        """The joint and its descendants, in index order."""
        members = {joint}
        for k in range(joint + 1, self.num_joints):
            if self.parents[k] in members:
                members.add(k)
        return tuple(sorted(members))

    def index(self, name: str) -> int:
        """Index of a joint. **Raises:** `KeyError` listing the names."""
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(f"no joint {name!r}; the tree has {', '.join(self.names)}") from None

    def indices(self, *names: str) -> tuple[int, ...]:
        """Indices of the given names; names that the tree lacks are skipped."""
        return tuple(self.names.index(name) for name in names if name in self.names)
