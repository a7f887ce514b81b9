"""A drivable avatar over many frames: one rest surface, moved and skinned in milliseconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..body import BodyModel, BodyParams, bone_transforms, check_params, with_betas
from ..export import SequenceFormat, write_sequence
from ..geometry import closest_points
from ..learning import progress
from ..meshing import Mesh
from .protocol import AbstractRestSurface, Drivable, Mode

Offsets = Literal["cached", "exact", "none"]
DEFAULT_FPS = 30.0
"""Frame rate of parameters, which have none of their own."""
_FRAME_BLOCK = 64


@runtime_checkable
class MotionLike(Protocol):
    """The part of `xa.Motion` that animations use.

    `fps`; the `up` axis; the `source`, for messages; and `to_params`, the parameters for a body.
    """

    @property
    def fps(self) -> float: ...
    @property
    def up(self) -> str: ...
    @property
    def source(self) -> str: ...
    def to_params(self, body: BodyModel) -> BodyParams: ...


class Drive(NamedTuple):
    """T frames as a rest surface takes them: conditions, and bone transforms."""

    conditions: PyTree[Array]
    transforms: Float[Array | np.ndarray, "*T J 4 4"]


class Spread(NamedTuple):
    """Mean, 99th percentile and maximum of distances, millimetres."""

    mean: float
    p99: float
    max: float

    @classmethod
    def of(cls, metres: Float[np.ndarray, "..."]) -> Spread:
        values = 1000 * np.asarray(metres, np.float64).ravel()
        return cls(float(values.mean()), float(np.quantile(values, 0.99)), float(values.max()))


@dataclass(frozen=True)
class AnimationAccuracy:
    """How far animated frames are from the avatar's own surfaces, millimetres.

    - `vertex`: between vertices with the same index, including motion along the surface.
    - `surface`: from an animated vertex to the closest point of the avatar's surface.
    - `frames`: how many frames were compared.
    """

    vertex: Spread
    surface: Spread
    frames: int


@dataclass(frozen=True, eq=False)
class Animation:
    """Posed surfaces of an avatar, frame by frame, computed when they are needed.

    `animation[k]` is the mesh of a frame; iteration gives all meshes. In fast mode all frames
    have the same faces, and `chunks` and `vertices` give positions only.

    - `params`: parameters of the T frames, with the avatar's shape.
    - `fps`: frames per second, for files that keep time.
    """

    avatar: Drivable
    params: BodyParams
    fps: float = DEFAULT_FPS
    mode: Mode = "fast"
    offsets: Offsets = "cached"
    source: str = "animation"

    def __len__(self) -> int:
        return len(self.params)

    def __getitem__(self, index: int) -> Mesh:
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        index = index % len(self)
        if self.mode == "full":
            return self.avatar.surface(self.params[index], mode="full")
        return Mesh(self.frame_vertices(index), self.faces, colors=self._rest.colors)

    def __iter__(self) -> Iterator[Mesh]:
        return (self[k] for k in range(len(self)))

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Faces of every frame. **Raises:** `ValueError` in full mode, where each has its own."""
        self._same_faces()
        return self._rest.faces

    def chunks(self, size: int = 16) -> Iterator[Float[np.ndarray, "n V 3"]]:
        """Posed vertices of `size` frames at a time, metres, float32; the last may be fewer.

        **Raises:** `ValueError` in full mode.
        """
        self._same_faces()
        if size < 1:
            raise ValueError(f"chunks of {size} frames; at least one is needed")
        for start in range(0, len(self), size):
            yield np.stack(
                [self.frame_vertices(k) for k in range(start, min(start + size, len(self)))]
            )

    def vertices(self, *, verbose: bool = False) -> Float[np.ndarray, "T V 3"]:
        """Posed vertices of all frames, metres: 0.6 MB a frame for 50,000 vertices.

        **Raises:** `ValueError` in full mode.
        """
        self._same_faces()
        out = np.empty((len(self), self._rest.vertices.shape[1], 3), np.float32)
        with progress("animation", len(self), verbose=verbose, unit="frame") as bar:
            for k in range(len(self)):
                out[k] = self.frame_vertices(k)
                bar.update(1)
        return out

    def error(self, num_frames: int = 8, *, verbose: bool = False) -> AnimationAccuracy:
        """Compare `num_frames`, evenly spread, with `avatar.surface`.

        **Raises:** `ValueError` in full mode.
        """
        self._same_faces()
        chosen = spread_frames(len(self), num_frames)
        between, away = [], []
        with progress("comparison", len(chosen), verbose=verbose, unit="frame") as bar:
            for k in chosen:
                fast, own = self.frame_vertices(int(k)), self.avatar.surface(self.params[int(k)])
                between.append(np.linalg.norm(fast - own.vertices, axis=1))
                away.append(closest_points(own.vertices, own.faces, fast)[0])
                bar.update(1)
        return AnimationAccuracy(
            Spread.of(np.stack(between)), Spread.of(np.stack(away)), len(chosen)
        )

    def export_sequence(
        self,
        folder: str | os.PathLike[str],
        *,
        format: SequenceFormat = "ply",
        normals: bool = True,
        verbose: bool = True,
    ) -> list[str]:
        """Write `frame_0000.ply` (or `.obj`) and so on into a new folder; gives their paths.

        Vertices and faces keep number and order in fast mode. The folder appears when all frames
        are in it: an interrupt leaves nothing.

        **Raises:** `FileExistsError` if there is something at `folder`; `ValueError` for another
        format; `OSError` if it cannot be written.
        """
        meshes = (mesh.compute_normals() if normals else mesh for mesh in self)
        with progress("frames", len(self), verbose=verbose, unit="frame") as bar:
            return write_sequence(folder, meshes, len(self), format=format, done=bar.update)

    def frame_vertices(self, index: int) -> Float[np.ndarray, "V 3"]:
        """Posed vertices of one frame, metres, float32. **Raises:** `ValueError` in full mode."""
        self._same_faces()
        if self.offsets == "exact":
            return self.avatar.surface(self.params[index]).vertices
        drive = jax.tree.map(lambda leaf: leaf[index], self.drive)
        return np.asarray(posed_vertices(self._rest, drive, self.offsets == "cached"))

    @cached_property
    def drive(self) -> Drive:
        """Conditions and bone transforms of all frames, made on first use."""
        return drive_frames(self._rest, self.avatar.body, self.params)

    @property
    def _rest(self) -> AbstractRestSurface:
        return self.avatar.rest

    def _same_faces(self) -> None:
        if self.mode == "full":
            raise ValueError("in full mode every frame has its own faces: iterate over the meshes")


def animate(
    avatar: Drivable,
    motion: MotionLike | BodyParams,
    *,
    mode: Mode = "fast",
    offsets: Offsets = "cached",
    fps: float | None = None,
) -> Animation:
    """The posed surface over a motion, or over parameters `(T, ...)`. Nothing is computed yet.

    `fast` moves and skins one rest surface, so all frames have the same faces. `offsets` decides
    how its vertices follow pose and expression: `cached` takes one step along the normals, in
    milliseconds; `exact` calls `avatar.surface` for each frame; `none` only skins.
    `Animation.error` measures the difference. `full` makes each frame's most accurate surface.

    The motion's world is kept (`Motion.to_y_up` turns it); its shape is replaced by the avatar's.
    `fps` replaces the motion's frame rate; parameters have none and get 30.

    **Raises:** `ValueError` for parameters that do not fit the body or are not finite, or a frame
    rate that is not positive; `TypeError` for anything but a motion or parameters.
    """
    for name, value, known in (
        ("mode", mode, ("fast", "full")),
        ("offsets", offsets, ("cached", "exact", "none")),
    ):
        if value not in known:
            raise ValueError(f"unknown {name} {value!r}: {', '.join(known)}")
    if isinstance(motion, BodyParams):
        params, rate, source = motion, DEFAULT_FPS, "parameters"
    elif isinstance(motion, MotionLike):
        params, rate, source = motion.to_params(avatar.body), motion.fps, motion.source
    else:
        raise TypeError(
            f"a motion (xa.load_motion) or xa.BodyParams is needed, found {type(motion).__name__}"
        )
    rate = rate if fps is None else fps
    if not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"frame rate {rate}; it must be positive")
    params = own_batch(avatar, params, source)
    return Animation(avatar, params, float(rate), mode, offsets, source)


def own_batch(avatar: Drivable, params: BodyParams, source: str) -> BodyParams:
    """Checked parameters with one batch axis and the avatar's shape."""
    if params.pose.ndim == 2:
        params = jax.tree.map(lambda leaf: leaf[None], params)
    if params.pose.ndim != 3 or len(params) == 0:
        raise ValueError(
            f"{source}: params.pose has shape {params.pose.shape}, expected (T, J, 3) with at "
            "least one frame"
        )
    check_params(avatar.body, params, what=source)
    return with_betas(params, avatar.betas)


def spread_frames(count: int, wanted: int) -> Int[np.ndarray, " n"]:
    """At most `wanted` of `count` frame numbers, evenly spread, with the first and the last."""
    if wanted < 1:
        raise ValueError(f"{wanted} frames; at least one is needed")
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


@eqx.filter_jit
def posed_vertices(rest: AbstractRestSurface, drive: Drive, offset: bool) -> Float[Array, "V 3"]:
    """Vertices of one frame, metres: moved by the frame's condition if asked, then skinned."""
    points = rest.under(drive.conditions) if offset else rest.vertices
    return skin_columns(points, rest.weights, jnp.asarray(drive.transforms))


@eqx.filter_jit
def skin_columns(
    points: Float[Array, "3 V"], weights: Float[Array, "J V"], transforms: Float[Array, "J 4 4"]
) -> Float[Array, "V 3"]:
    """`kinematics.skin_points` for points and weights stored by columns."""
    flat = transforms[:, :3].reshape(transforms.shape[0], 12).astype(points.dtype)
    blended = jnp.matmul(flat.T, weights, precision=jax.lax.Precision.HIGHEST)
    m, (x, y, z) = blended.reshape(3, 4, -1), points
    # Written out: as a sum over an axis of three, compiled for a CPU, it takes ten times as long.
    return (m[:, 0] * x + m[:, 1] * y + m[:, 2] * z + m[:, 3]).T


def posed_frame(avatar: Drivable, params: BodyParams) -> Float[np.ndarray, "V 3"]:
    """Vertices of one frame as `Animation` makes them, metres, for parameters without a batch.

    For poses that come one at a time: nothing is compiled for a number of frames.

    **Raises:** `ValueError` for parameters that do not fit the body.
    """
    own = own_batch(avatar, params, "parameters")[0]
    return np.asarray(posed_vertices(avatar.rest, _drive(avatar.rest, avatar.body, own), True))


def drive_frames(rest: AbstractRestSurface, body: BodyModel, params: BodyParams) -> Drive:
    """Conditions and transforms of all frames, a block of frames at a time: one compilation."""
    count = len(params)
    rows = np.minimum(np.arange(-(-count // _FRAME_BLOCK) * _FRAME_BLOCK), count - 1)
    blocks = [
        _drive_block(rest, body, params[rows[k : k + _FRAME_BLOCK]])
        for k in range(0, len(rows), _FRAME_BLOCK)
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count].astype(np.float32), *blocks)


@eqx.filter_jit
def _drive(rest: AbstractRestSurface, body: BodyModel, params: BodyParams) -> Drive:
    return Drive(rest.condition(params), bone_transforms(body, params))


@eqx.filter_jit
def _drive_block(rest: AbstractRestSurface, body: BodyModel, params: BodyParams) -> Drive:
    return jax.vmap(lambda p: _drive(rest, body, p))(params)
