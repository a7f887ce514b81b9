"""The text of a BVH file: a tree of joints with offsets and channels, and a row for each frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Skeleton:
    """Joints of a BVH file, parents before children.

    Attributes:
        names: of the joints, as in the file.
        parents: index of each joint's parent, -1 for the root.
        offsets: from the parent, in the file's unit.
        channels: of each joint, in order: `Xposition`, `Zrotation` and so on.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "J 3"]
    channels: tuple[tuple[str, ...], ...]


def parse(text: str, where: str) -> tuple[Skeleton, Float[np.ndarray, "T C"], float]:
    """Skeleton, channel values and seconds a frame.

    Args:
        text: of the file.
        where: file, for messages.

    Raises:
        ValueError: naming the line that is not as the format wants it.
    """
    lines = _lines(text)
    skeleton = _hierarchy(lines, where)
    width = sum(map(len, skeleton.channels))
    frames = int(_number(_expect(lines, where, "Frames:"), where))
    interval = _number(_expect(lines, where, "Frame", "Time:"), where)
    rows = []
    for number, words in lines:
        if len(words) != width:
            raise ValueError(
                f"{where}, line {number}: {len(words)} numbers, but the joints have {width} "
                "channels."
            )
        rows.append([_number((number, [word]), where) for word in words])
    if len(rows) != frames:
        raise ValueError(f"{where}: Frames: {frames}, but {len(rows)} rows of numbers.")
    return skeleton, np.array(rows, np.float64).reshape(frames, width), interval


def local_rotations(
    skeleton: Skeleton, values: Float[np.ndarray, "T C"]
) -> Float[np.ndarray, "T J 3 3"]:
    """Rotation of every joint relative to its parent; channels apply from the left, in order."""
    from scipy.spatial.transform import Rotation

    rotations = np.tile(np.eye(3), (len(values), len(skeleton.names), 1, 1))
    start = 0
    for joint, channels in enumerate(skeleton.channels):
        turns = [k for k, name in enumerate(channels) if name.lower().endswith("rotation")]
        if turns:
            axes = "".join(channels[k][0].upper() for k in turns)
            angles = values[:, [start + k for k in turns]]
            rotation = Rotation.from_euler(axes, angles, degrees=True)
            rotations[:, joint] = rotation.as_matrix().reshape(-1, 3, 3)
        start += len(channels)
    return rotations


def local_places(
    skeleton: Skeleton, values: Float[np.ndarray, "T C"]
) -> Float[np.ndarray, "T J 3"]:
    """Place of every joint relative to its parent: position channels where it has them, else its
    offset."""
    places = np.tile(skeleton.offsets, (len(values), 1, 1))
    start = 0
    for joint, channels in enumerate(skeleton.channels):
        for k, name in enumerate(channels):
            if name.lower().endswith("position"):
                places[:, joint, _AXES[name[0].lower()]] = values[:, start + k]
        start += len(channels)
    return places


def write(
    skeleton: Skeleton, ends: dict[int, np.ndarray], values: np.ndarray, interval: float
) -> str:
    """The text of a BVH file.

    Args:
        skeleton: of any order; the file's is depth first, which its rows follow.
        ends: offsets of the end sites of joints without children.
        values: channels in the order of the skeleton, `(T, C)`.
        interval: seconds a frame.
    """
    lines, columns = ["HIERARCHY"], []
    starts = np.cumsum([0, *map(len, skeleton.channels)])

    def add(joint: int, depth: int) -> None:
        indent = "\t" * depth
        channels = skeleton.channels[joint]
        columns.extend(range(starts[joint], starts[joint + 1]))
        lines.append(f"{indent}{'JOINT' if depth else 'ROOT'} {skeleton.names[joint]}")
        lines.extend([f"{indent}{{", f"{indent}\tOFFSET {_row(skeleton.offsets[joint])}"])
        lines.append(f"{indent}\tCHANNELS {len(channels)} {' '.join(channels)}")
        for child in [j for j, parent in enumerate(skeleton.parents) if parent == joint]:
            add(child, depth + 1)
        if joint in ends:
            lines.extend([f"{indent}\tEnd Site", f"{indent}\t{{"])
            lines.extend([f"{indent}\t\tOFFSET {_row(ends[joint])}", f"{indent}\t}}"])
        lines.append(f"{indent}}}")

    add(0, 0)
    lines += ["MOTION", f"Frames: {len(values)}", f"Frame Time: {interval!r}"]
    lines += [_row(row) for row in values[:, columns]]
    return "\n".join(lines) + "\n"


def _row(values: np.ndarray) -> str:
    # Twelve digits: float32 comes back bit for bit through degrees and Euler angles.
    return " ".join(f"{value:.12g}" for value in values)


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(text.splitlines(), start=1):
        # Braces may stand at the end of a line.
        for part in line.replace("{", "\n{\n").replace("}", "\n}\n").split("\n"):
            words = part.split()
            if words:
                yield number, words


def _expect(
    lines: Iterator[tuple[int, list[str]]], where: str, *words: str
) -> tuple[int, list[str]]:
    number, found = next(lines, (0, []))
    if [word.lower() for word in found[: len(words)]] != [word.lower() for word in words]:
        place = f"line {number}: {' '.join(found)[:60]!r}" if found else "the file ends"
        raise ValueError(f"{where}: expected {' '.join(words)!r}, but {place}.")
    return number, found[len(words) :]


def _number(line: tuple[int, list[str]], where: str) -> float:
    number, words = line
    try:
        return float(words[0])
    except (ValueError, IndexError):
        raise ValueError(f"{where}, line {number}: expected a number, found {words[:1]}.") from None


def _hierarchy(lines: Iterator[tuple[int, list[str]]], where: str) -> Skeleton:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[np.ndarray] = []
    channels: list[tuple[str, ...]] = []
    open_joints: list[int | None] = []  # None is an end site, whose offset moves nothing
    _expect(lines, where, "HIERARCHY")
    for number, words in lines:
        kind = words[0].upper()
        if kind == "MOTION":
            if open_joints or not names:
                break
            return Skeleton(tuple(names), tuple(parents), np.stack(offsets), tuple(channels))
        if kind in ("ROOT", "JOINT") and len(words) > 1:
            if kind == "ROOT" and names:
                raise ValueError(f"{where}, line {number}: a second skeleton; keep one.")
            parent = open_joints[-1] if open_joints else -1
            name = " ".join(words[1:])
            if parent is None or (parent == -1 and names) or name in names:
                raise ValueError(f"{where}, line {number}: joint {name!r} stands where none can.")
            names.append(name)
            parents.append(parent)
            offsets.append(np.zeros(3))
            channels.append(())
            _expect(lines, where, "{")
            open_joints.append(len(names) - 1)
        elif kind == "END":
            _expect(lines, where, "{")
            open_joints.append(None)
        elif kind == "}" and open_joints:
            open_joints.pop()
        elif kind == "OFFSET" and open_joints and len(words) == 4:
            offset = np.array([_number((number, [word]), where) for word in words[1:]])
            if open_joints[-1] is not None:
                offsets[open_joints[-1]] = offset
        elif kind == "CHANNELS" and open_joints and open_joints[-1] is not None:
            channels[open_joints[-1]] = _channels(words[1:], number, where)
        else:
            raise ValueError(f"{where}, line {number}: {' '.join(words)[:60]!r} is no BVH.")
    raise ValueError(f"{where}: the skeleton is not closed before MOTION, or there is no MOTION.")


def _channels(words: list[str], number: int, where: str) -> tuple[str, ...]:
    known = {f"{axis}{what}" for axis in "xyz" for what in ("position", "rotation")}
    names = words[1:]
    if words[:1] != [str(len(names))] or any(name.lower() not in known for name in names):
        raise ValueError(f"{where}, line {number}: CHANNELS {' '.join(words)} is not understood.")
    if len({name.lower() for name in names}) != len(names):
        raise ValueError(f"{where}, line {number}: a channel stands twice.")
    return tuple(names)
