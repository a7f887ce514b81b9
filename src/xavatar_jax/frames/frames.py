"""Lazy sequences of posed meshes with the body parameters of each frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, overload

import jax
import numpy as np
from jaxtyping import Float, Int, Int8

from ..body import BodyModel, BodyParams
from ..files.meshes import check_mesh, read_mesh
from ..geometry import enclosed_volume

LoadMesh = Callable[[int], tuple[np.ndarray, np.ndarray]]
PartLabels = np.ndarray | Callable[[int, np.ndarray], np.ndarray | None] | None


@dataclass(frozen=True, eq=False)
class Frame:
    """One posed mesh and the body parameters it was posed with.

    Attributes:
        vertices: posed vertices, metres, in the world of `params`.
        faces: triangles as vertex indices.
        params: unbatched body parameters.
        part_labels: part of the body for each vertex, or None if unknown.
        source: name of the frame, for messages.
        turned: whether the mesh was inside out and its triangles have been flipped.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    params: BodyParams
    part_labels: Int8[np.ndarray, " V"] | None
    source: str
    turned: bool = False


@dataclass(frozen=True, eq=False)
class _Sources:
    """The loader and the names, shared by all views of one `Frames`."""

    load: LoadMesh
    part_labels: PartLabels
    names: tuple[str, ...]
    sequence_names: tuple[str, ...]
    sequence_index: np.ndarray = field(repr=False)
    body: BodyModel | None


class Frames(Sequence[Frame]):
    """A sequence of frames whose meshes are loaded one at a time, on access.

    `frames[3]` is a `Frame`; `frames[10:20]` and `frames[np.array([1, 5])]` are `Frames` that
    share the loader. No mesh is kept, so memory does not grow with the number of frames.
    Triangles of a mesh that is inside out are flipped, and its frame says so (`turned`).

    Args:
        params: body parameters, batched over the N frames.
        load: returns vertices (V, 3) and faces (F, 3) of frame `i`.
        part_labels: labels (V,) shared by all frames, a function of `i` and the vertices of that
            frame, or None.
        sources: a name for each frame, used in messages.
        sequence_names: names of the sequences the frames come from.
        sequence_index: index into `sequence_names` for each frame.
        body: the body that the parameters are for, if known.

    Raises:
        ValueError: no frames, counts that do not match, or parameters that are not finite.
    """

    def __init__(
        self,
        params: BodyParams,
        load: LoadMesh,
        *,
        part_labels: PartLabels = None,
        sources: Sequence[str] | None = None,
        sequence_names: Sequence[str] = ("sequence",),
        sequence_index: Int[np.ndarray, " N"] | Sequence[int] | None = None,
        body: BodyModel | None = None,
    ):
        count = _batch_size(params)
        names = tuple(sources) if sources is not None else _numbered(count)
        index = np.zeros(count, np.int64) if sequence_index is None else np.asarray(sequence_index)
        _check_counts(count, names, tuple(sequence_names), index)
        check_finite(params, names)
        labels = part_labels
        if labels is not None and not callable(labels):
            labels = np.asarray(labels, np.int8)
        self._sources = _Sources(load, labels, names, tuple(sequence_names), index, body)
        self._params = params
        self._index = np.arange(count)

    @classmethod
    def from_meshes(
        cls,
        meshes: Sequence[Any],
        params: BodyParams,
        *,
        part_labels: PartLabels = None,
        sources: Sequence[str] | None = None,
        sequence_names: Sequence[str] = ("sequence",),
        sequence_index: Int[np.ndarray, " N"] | Sequence[int] | None = None,
        body: BodyModel | None = None,
    ) -> Frames:
        """Frames from meshes: `(vertices, faces)` pairs, objects with both, or file paths.

        `meshes` is indexed, and paths are read, when a frame is accessed.

        Args:
            meshes: N meshes, vertices in metres.
            params: body parameters batched over the N meshes.
            part_labels, sources, sequence_names, sequence_index, body: as for `Frames`.

        Raises:
            ValueError: the numbers of meshes and parameters differ, or as for `Frames`.
        """
        count = _batch_size(params)
        if len(meshes) != count:
            raise ValueError(
                f"{len(meshes)} meshes but parameters for {count} frames: "
                "one set of parameters for each mesh is needed."
            )
        if sources is None and all(isinstance(mesh, str | Path) for mesh in meshes):
            sources = [str(mesh) for mesh in meshes]
        return cls(
            params,
            lambda i: _as_vertices_and_faces(meshes[i]),
            part_labels=part_labels,
            sources=sources,
            sequence_names=sequence_names,
            sequence_index=sequence_index,
            body=body,
        )

    @property
    def body(self) -> BodyModel | None:
        """The body that the parameters are for, or None if it was not given."""
        return self._sources.body

    @property
    def params(self) -> BodyParams:
        """Body parameters, batched over the frames."""
        return self._params

    @property
    def sources(self) -> tuple[str, ...]:
        """The name of each frame."""
        return tuple(self._sources.names[i] for i in self._index)

    @property
    def sequence_names(self) -> tuple[str, ...]:
        """The names of the sequences."""
        return self._sources.sequence_names

    @property
    def sequence_index(self) -> Int[np.ndarray, " N"]:
        """Index into `sequence_names` for each frame."""
        return self._sources.sequence_index[self._index]

    @property
    def sequences(self) -> dict[str, Frames]:
        """The frames of each sequence, by name, in order of first appearance."""
        index = self.sequence_index
        order = dict.fromkeys(int(i) for i in index)
        return {self.sequence_names[i]: self[np.flatnonzero(index == i)] for i in order}

    def with_params(self, params: BodyParams, body: BodyModel | None = None) -> Frames:
        """The same meshes with other parameters, for another body.

        Raises:
            ValueError: the numbers of parameters and frames differ, or some are not finite.
        """
        if _batch_size(params) != len(self):
            raise ValueError(f"parameters for {_batch_size(params)} frames; there are {len(self)}.")
        check_finite(params, self.sources)
        return self._view(replace(self._sources, body=body), params, self._index)

    def __len__(self) -> int:
        return len(self._index)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice | np.ndarray | Sequence[int]) -> Frames: ...
    def __getitem__(self, index):
        if isinstance(index, int | np.integer):
            return self._frame(int(index))
        positions = np.arange(len(self))[index if isinstance(index, slice) else np.asarray(index)]
        if positions.ndim != 1 or len(positions) == 0:
            raise ValueError(f"Selecting {index} from {len(self)} frames leaves no frames.")
        return self._view(self._sources, _take(self._params, positions), self._index[positions])

    @staticmethod
    def _view(sources: _Sources, params: BodyParams, index: np.ndarray) -> Frames:
        view = object.__new__(Frames)
        view._sources, view._params, view._index = sources, params, index
        return view

    def _frame(self, position: int) -> Frame:
        if not -len(self) <= position < len(self):
            raise IndexError(f"Frame {position} of {len(self)}.")
        position %= len(self)
        shared, i = self._sources, int(self._index[position])
        vertices, faces = shared.load(i)
        vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
        check_mesh(vertices, faces, shared.names[i])
        labels = shared.part_labels
        if callable(labels):
            labels = labels(i, vertices)
        if labels is not None and np.shape(labels) != (len(vertices),):
            raise ValueError(
                f"{shared.names[i]}: part labels of shape {np.shape(labels)} for "
                f"{len(vertices)} vertices; expected ({len(vertices)},)."
            )
        params = _take(self._params, position)
        # Inside is decided by winding numbers, which need triangles that face outwards.
        turned = enclosed_volume(vertices, faces) < 0
        faces = faces[:, ::-1] if turned else faces
        return Frame(vertices, faces, params, labels, shared.names[i], turned)

    def __repr__(self) -> str:
        return f"Frames({len(self)} frames, {len(set(self.sequence_index))} sequences)"


def check_finite(params: BodyParams, sources: Sequence[str]) -> None:
    """Raise `ValueError`, naming the frame and the field, if a parameter is not finite."""
    for name in ("pose", "betas", "expression", "transl"):
        values = np.asarray(getattr(params, name))
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if bad.any():
            first = int(np.flatnonzero(bad)[0])
            raise ValueError(
                f"{sources[first]}: params.{name} is not finite "
                f"({int(bad.sum())} of {len(values)} frames have NaN or infinite {name})."
            )


def _take(params: BodyParams, index: int | np.ndarray) -> BodyParams:
    return jax.tree.map(lambda leaf: leaf[index], params)


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"frame {i}" for i in range(count))


def _batch_size(params: BodyParams) -> int:
    shapes = {n: np.shape(getattr(params, n)) for n in ("pose", "betas", "expression", "transl")}
    expected = {"pose": 3, "betas": 2, "expression": 2, "transl": 2}
    for name, shape in shapes.items():
        if len(shape) != expected[name]:
            raise ValueError(
                f"params.{name} has shape {shape}; frames need parameters with one batch axis, "
                f"{expected[name]} axes in all. For one frame, add an axis of length 1."
            )
    counts = {name: shape[0] for name, shape in shapes.items()}
    if len(set(counts.values())) != 1:
        raise ValueError(f"Parameters disagree on the number of frames: {counts}.")
    if counts["pose"] == 0:
        raise ValueError("Parameters for 0 frames; at least one frame is needed.")
    return counts["pose"]


def _check_counts(
    count: int, sources: tuple[str, ...], names: tuple[str, ...], index: np.ndarray
) -> None:
    if len(sources) != count:
        raise ValueError(f"{len(sources)} sources for {count} frames.")
    if index.shape != (count,):
        raise ValueError(f"sequence_index has shape {index.shape}, expected ({count},).")
    if index.min() < 0 or index.max() >= len(names):
        raise ValueError(
            f"sequence_index goes from {index.min()} to {index.max()}, but there are "
            f"{len(names)} sequence_names."
        )
    if len(set(names)) != len(names):
        raise ValueError(f"sequence_names are not distinct: {', '.join(names)}.")


def _as_vertices_and_faces(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(mesh, str | Path):
        return read_mesh(mesh)
    if hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        return np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if isinstance(mesh, tuple | list) and len(mesh) == 2:
        return np.asarray(mesh[0]), np.asarray(mesh[1])
    raise ValueError(
        f"Not a mesh: {type(mesh).__name__}. Give (vertices, faces), an object with `vertices` "
        "and `faces`, or a path."
    )


def known_body(frames: Frames, body: BodyModel | None) -> BodyModel:
    """`body`, or else the body of the frames.

    **Raises:** `ValueError` if neither is known.
    """
    body = frames.body if body is None else body
    if body is None:
        raise ValueError("the body of these frames is not known: pass body=load_body(...)")
    return body


def spread(frames: Frames, n: int | None) -> Int[np.ndarray, " n"]:
    """Sorted indices of `n` frames, spread evenly over the sequences and in time within each.

    Sequences shorter than their share contribute all their frames, and the others contribute
    more. Deterministic.

    Args:
        frames: frames of one or more sequences.
        n: the number of frames; None, or more than there are, selects all.

    Raises:
        ValueError: `n` is less than 1.
    """
    if n is not None and n < 1:
        raise ValueError(f"Cannot select {n} frames; at least 1 is needed.")
    if n is None or n >= len(frames):
        return np.arange(len(frames))
    index = frames.sequence_index
    groups = [np.flatnonzero(index == i) for i in dict.fromkeys(index.tolist())]
    chosen = [
        group[_evenly(len(group), quota)]
        for group, quota in zip(groups, _quotas([len(g) for g in groups], n), strict=True)
    ]
    return np.sort(np.concatenate(chosen))


def _quotas(sizes: list[int], n: int) -> list[int]:
    """Share `n` among groups as equally as their sizes allow."""
    quotas = [0] * len(sizes)
    left = n
    while left:
        open_groups = [i for i, size in enumerate(sizes) if quotas[i] < size]
        # Fewer than groups: choose groups spread over the list, not the first ones.
        if left < len(open_groups):
            open_groups = [open_groups[i] for i in _evenly(len(open_groups), left)]
        share = max(left // len(open_groups), 1)
        for i in open_groups:
            given = min(share, sizes[i] - quotas[i])
            quotas[i] += given
            left -= given
    return quotas


def _evenly(size: int, n: int) -> np.ndarray:
    """`n` distinct positions out of `size`: the centres of `n` equal intervals."""
    return ((np.arange(n) + 0.5) * size / n).astype(np.int64)
