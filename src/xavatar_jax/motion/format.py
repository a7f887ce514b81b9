"""What every reader of a motion format is made of, and what it is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..body import BodyModel
from ..files import is_torch, load_json, load_npy, load_npz, load_pickle, load_torch
from .record import Motion, UpAxis

Kind = Literal["npz", "npy", "pickle", "torch", "json", "bvh", "folder", "unknown"]
BODY_ONLY = (
    "BODY ONLY: the file holds SMPL, which has no fingers, jaw, eyes or expression; they stay at "
    "rest. SMPL's joints are not quite SMPL-X's, so poses are off by a few degrees"
)
DEFAULT_FPS = 30.0  # of formats that store no frame rate: the rate of ordinary video


@dataclass(frozen=True)
class Source:
    """A file or folder as its content shows it, before anybody has said what format it is.

    Attributes:
        path: the file or folder.
        kind: the container, by its first bytes.
        data: entries of an archive, the object in a pickle, a parsed JSON document, the text of a
            BVH file, or the paths inside a folder; None where the kind is unknown.
    """

    path: Path
    kind: Kind
    data: Any = None

    @property
    def keys(self) -> set[str]:
        """Names of the entries, of an archive or of a dictionary in a pickle."""
        return {str(key) for key in self.data} if isinstance(self.data, dict) else set()

    def describe(self) -> str:
        """What was found, for messages."""
        if self.kind == "folder":
            names = sorted(p.relative_to(self.path).as_posix() for p in self.data)
            return f"a folder with {_listing(names, 'files')}"
        if isinstance(self.data, dict):
            names = sorted(map(str, self.data))
            return f"{_TITLES[self.kind]} with {_listing(names, 'entries')}"
        if isinstance(self.data, np.ndarray):
            return f"{_TITLES[self.kind]} of shape {self.data.shape}"
        if isinstance(self.data, list):
            return f"{_TITLES[self.kind]} with a list of {len(self.data)}"
        return _TITLES[self.kind]


_TITLES = {
    "npz": "an .npz archive", "npy": "an .npy array", "pickle": "a pickle",
    "torch": "a PyTorch file",
    "json": "a JSON document", "bvh": "a BVH file", "folder": "a folder",
    "unknown": "neither .npz, .npy, pickle, JSON nor BVH",
}  # fmt: skip


@dataclass(frozen=True)
class ReadOptions:
    """What the caller of `load_motion` says beside the path; None leaves it to the file.

    Attributes: as the arguments of `load_motion`.
    """

    body: BodyModel | None = None
    fps: float | None = None
    up: UpAxis | None = None
    person: int | None = None
    joint_map: str | Path | Mapping[str, str] | None = None
    scale: float | None = None
    flat_hand_mean: bool | None = None

    def frame_rate(self, notices: list[str]) -> float:
        """The rate given, else the assumed one with a notice: for formats that store none."""
        if self.fps is None:
            notices.append(
                f"the format stores no frame rate: {DEFAULT_FPS:g} a second assumed; "
                "pass fps= if it is another"
            )
        return DEFAULT_FPS if self.fps is None else self.fps

    def turned(self, where: str) -> UpAxis:
        """The up axis of readers that turn what they read y-up themselves.

        Raises:
            ValueError: the caller asks for another.
        """
        if self.up not in (None, "y"):
            raise ValueError(
                f"{where}: motions of this format are turned y-up as they are read; leave out "
                "up=, and use motion.to_z_up(body) afterwards."
            )
        return "y"


@dataclass(frozen=True)
class Format:
    """One motion format.

    Attributes:
        name: what `load_motion(format=...)` takes.
        title: for people.
        sought: what a file of this format looks like, for messages.
        recognise: whether a source is of this format.
        read: the motion in it.
    """

    name: str
    title: str
    sought: str
    recognise: Callable[[Source], bool] = field(repr=False)
    read: Callable[[Source, ReadOptions], Motion] = field(repr=False)


def open_source(path: str | Path) -> Source:
    """Open a file or folder by what it holds, whatever its name ends in.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        ValueError: the file is damaged, or a pickle that is more than data.
    """
    path = Path(path)
    if path.is_dir():
        files = [p for depth in ("*", "*/*") for p in path.glob(depth) if p.is_file()]
        return Source(path, "folder", sorted(p for p in files if p.name[0] != "."))
    if not path.is_file():
        raise FileNotFoundError(f"No motion file or folder at {path}.")
    with open(path, "rb") as file:
        head = file.read(512)
    if head[:4] == b"PK\x03\x04":
        if is_torch(path):
            return Source(path, "torch", load_torch(path))
        return Source(path, "npz", load_npz(path))
    if head[:6] == b"\x93NUMPY":
        return Source(path, "npy", load_npy(path))
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start[:9].upper() == b"HIERARCHY":
        return Source(path, "bvh", path.read_text(encoding="utf-8-sig", errors="replace"))
    if start[:1] in (b"{", b"[") and path.suffix.lower() not in _PICKLES:
        return Source(path, "json", load_json(path))
    if head[:1] == b"\x80" or path.suffix.lower() in _PICKLES:
        return Source(path, "pickle", load_pickle(path))
    return Source(path, "unknown")


# Compressed pickles and those of the oldest protocols begin like anything: there the name decides.
_PICKLES = (".pkl", ".p", ".pickle", ".joblib", ".pk", ".gz", ".bz2", ".xz", ".lzma", ".z")


def _listing(names: list[str], what: str) -> str:
    if not names:
        return f"no {what}"
    shown = ", ".join(names[:12])
    return f"{shown}, ... ({len(names)} {what})" if len(names) > 12 else shown


def choose_person(counts: Mapping[int, int], person: int | None, where: str | Path) -> int:
    """The requested person, or the only one.

    Args:
        counts: number of frames of each person.
        person: the requested one, or None.
        where: file, for messages.

    Raises:
        ValueError: there is no such person, or there are several and none was requested.
    """
    listed = ", ".join(f"{key} ({count} frames)" for key, count in sorted(counts.items()))
    if not counts:
        raise ValueError(f"{where}: there is no person in it.")
    if person is not None:
        if person not in counts:
            raise ValueError(f"{where}: no person {person}; there are {listed}.")
        return person
    if len(counts) > 1:
        raise ValueError(f"{where}: {len(counts)} people: {listed}. Choose one with person=.")
    return next(iter(counts))
