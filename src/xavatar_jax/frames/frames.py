"""`Frames`: a lazy sequence of posed meshes with the body parameters of each."""

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
PartLabels = np.ndarray | Callable[[int], np.ndarray | None] | None


@dataclass(frozen=True)
class Frame:
    """One posed mesh and the body parameters it was posed with.

    Attributes:
        vertices: posed vertices, metres, in the world of `params`.
        faces: triangles as vertex indices.
        params: unbatched body parameters.
        part_labels: index into `body.PARTS` for each vertex, or None where unknown.
        source: where the frame comes from, for messages.
        turned: whether the mesh was inside out, so that its triangles were turned round.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    params: BodyParams
    part_labels: Int8[np.ndarray, " V"] | None
    source: str
    turned: bool = False


@dataclass(frozen=True)
class _Sources:
    """What every view of one `Frames` shares: the loader and the names."""

    load: LoadMesh
    part_labels: PartLabels
    names: tuple[str, ...]
    sequence_names: tuple[str, ...]
    sequence_index: np.ndarray = field(repr=False)
    body: BodyModel | None


class Frames(Sequence[Frame]):
    """A sequence of frames whose meshes are loaded one at a time, when asked for.

    `frames[3]` is a `Frame`; `frames[10:20]` and `frames[np.array([1, 5])]` are `Frames` that
    share the loader. No mesh is kept, so memory does not grow with the number of frames.
    A mesh whose triangles face inwards is turned round, which its frame says (`turned`).

    Args:
        params: body parameters, batched over the N frames.
        load: gives vertices (V, 3) and faces (F, 3) of frame `i`.
        part_labels: labels (V,) shared by all frames, or a function of `i`, or None.
        sources: a name for each frame, used in messages.
        sequence_names: names of the sequences the frames come from.
        sequence_index: for each frame, which of `sequence_names` it belongs to.
        body: the body that the parameters are for, where it is known.

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

        Paths are read when a frame is asked for. `meshes` is indexed lazily, so a sequence that
        makes its meshes on access stays lazy.

        Args:
            meshes: N meshes, vertices in metres.
            params: body parameters batched over the N meshes.
            part_labels, sources, sequence_names, sequence_index, body: as for `Frames`.

        Raises:
            ValueError: another number of meshes than of parameters, or as for `Frames`.
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
        """The body that the parameters are for, or None where it was not given."""
        return self._sources.body

    @property
    def params(self) -> BodyParams:
        """Body parameters, batched over the frames."""
        return self._params

    @property
    def sources(self) -> tuple[str, ...]:
        """Where each frame comes from."""
        return tuple(self._sources.names[i] for i in self._index)

    @property
    def sequence_names(self) -> tuple[str, ...]:
        """Names that `sequence_index` refers to."""
        return self._sources.sequence_names

    @property
    def sequence_index(self) -> Int[np.ndarray, " N"]:
        """For each frame, the index of its sequence in `sequence_names`."""
        return self._sources.sequence_index[self._index]

    @property
    def sequences(self) -> dict[str, Frames]:
        """The frames of each sequence, by name, in order of first appearance."""
        index = self.sequence_index
        order = dict.fromkeys(int(i) for i in index)
        return {self.sequence_names[i]: self[np.flatnonzero(index == i)] for i in order}

    def with_params(self, params: BodyParams, body: BodyModel | None = None) -> Frames:
        """The same meshes with other parameters, of another body.

        Raises:
            ValueError: another number of parameters than of frames, or some that are not finite.
        """
        if _batch_size(params) != len(self):
            raise ValueError(f"parameters for {_batch_size(params)} frames; there are {len(self)}.")
        check_finite(params, self.sources)
        view = object.__new__(Frames)
        view._sources = replace(self._sources, body=body)
        view._params = params
        view._index = self._index
        return view

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
        view = object.__new__(Frames)
        view._sources = self._sources
        view._params = _take(self._params, positions)
        view._index = self._index[positions]
        return view

    def _frame(self, position: int) -> Frame:
        if not -len(self) <= position < len(self):
            raise IndexError(f"Frame {position} of {len(self)}.")
        position %= len(self)
        shared, i = self._sources, int(self._index[position])
        vertices, faces = shared.load(i)
        vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
        check_mesh(vertices, faces, shared.names[i])
        labels = shared.part_labels(i) if callable(shared.part_labels) else shared.part_labels
        if labels is not None and np.shape(labels) != (len(vertices),):
            raise ValueError(
                f"{shared.names[i]}: part labels of shape {np.shape(labels)} for "
                f"{len(vertices)} vertices; expected ({len(vertices)},)."
            )
        params = _take(self._params, position)
        # Winding numbers decide what is inside, which need triangles that face outwards.
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
        raise ValueError("Parameters for 0 frames: there is nothing to make frames of.")
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
    """The body given, or else that of the frames.

    **Raises:** `ValueError` if neither is there.
    """
    body = frames.body if body is None else body
    if body is None:
        raise ValueError(
            "these frames do not say which body they are for: pass body=load_body(...)"
        )
    return body
