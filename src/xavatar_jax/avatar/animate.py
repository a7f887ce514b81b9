"""An avatar over many frames: one base mesh, moved and skinned at the cost of milliseconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..body import (
    BodyModel,
    BodyParams,
    bone_transforms,
    canonical_params,
    check_params,
    with_betas,
)
from ..export import SequenceFormat, write_sequence
from ..fields import AbstractFixedPoints
from ..geometry import closest_points
from ..meshing import Mesh
from ..training import AvatarFields
from ..training.progress import progress
from .pointwise import PROJECT_STEP, PROJECT_STEPS, batch_size, gradients, in_batches, skin_weights

if TYPE_CHECKING:
    from .avatar import Avatar

Offsets = Literal["cached", "exact", "none"]
DEFAULT_FPS = 30.0
_LARGEST_STEP = PROJECT_STEPS * PROJECT_STEP  # as far as the exact way goes
_FRAME_BLOCK = 64


@runtime_checkable
class MotionLike(Protocol):
    """What is asked of a motion: see `xa.Motion`."""

    @property
    def fps(self) -> float: ...
    @property
    def up(self) -> str: ...
    @property
    def source(self) -> str: ...
    def to_params(self, body: BodyModel) -> BodyParams: ...


class NeutralSurface(eqx.Module):
    """The neutral surface, and what of it is the same in every frame. Vertices are columns.

    - `vertices`: metres, canonical space; `normals`: unit gradients of the field, inwards.
    - `slopes`: length of the gradient, logits a metre.
    - `weights`: skinning weights at the vertices.
    - `logits`: the geometry field at the vertices.
    """

    vertices: Float[Array, "3 V"]
    normals: Float[Array, "3 V"]
    slopes: Float[Array, " V"]
    weights: Float[Array, "J V"]
    logits: AbstractFixedPoints


class Drive(NamedTuple):
    """What T frames do to the fields: conditions, and bone transforms `(T, J, 4, 4)`."""

    conditions: Any
    transforms: Float[Array, "T J 4 4"]


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
    """How far animated frames lie from those that `Avatar.mesh` gives, millimetres.

    - `vertex`: between vertices of the same number, sliding along the surface included.
    - `surface`: from an animated vertex to the closest point of the other surface.
    - `frames`: how many frames were compared.
    """

    vertex: Spread
    surface: Spread
    frames: int


@dataclass(frozen=True, eq=False)
class Animation:
    """Posed surfaces of an avatar, frame by frame, computed when they are asked for.

    `animation[k]` is the mesh of a frame, iteration gives the meshes of all. In fast mode all
    frames share their faces; `chunks` and `vertices` give bare positions.

    - `params`: of the T frames, with the avatar's own shape.
    - `fps`: frames a second, for files that keep time.
    """

    avatar: Avatar
    params: BodyParams
    fps: float = DEFAULT_FPS
    mode: Literal["fast", "full"] = "fast"
    offsets: Offsets = "cached"
    source: str = "animation"

    def __len__(self) -> int:
        return len(self.params)

    def __getitem__(self, index: int) -> Mesh:
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        index = index % len(self)
        if self.mode == "full":
            return self.avatar.mesh(self.params[index], mode="full")
        return replace(
            self.avatar.canonical_mesh(), vertices=self.frame_vertices(index), normals=None
        )

    def __iter__(self) -> Iterator[Mesh]:
        return (self[k] for k in range(len(self)))

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Faces of every frame. **Raises:** `ValueError` in full mode, where each has its own."""
        self._same_faces()
        return self.avatar.canonical_mesh().faces

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
        out = np.empty((len(self), self.avatar.canonical_mesh().num_vertices, 3), np.float32)
        with progress("animation", len(self), verbose=verbose, unit="frame") as bar:
            for k in range(len(self)):
                out[k] = self.frame_vertices(k)
                bar.update(1)
        return out

    def error(self, num_frames: int = 8, *, verbose: bool = False) -> AnimationAccuracy:
        """Compare `num_frames`, evenly spread, with the frames' own meshes.

        **Raises:** `ValueError` in full mode.
        """
        self._same_faces()
        chosen = spread_frames(len(self), num_frames)
        between, away = [], []
        with progress("comparison", len(chosen), verbose=verbose, unit="frame") as bar:
            for k in chosen:
                fast, own = self.frame_vertices(int(k)), self.avatar.mesh(self.params[int(k)])
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
            return self.avatar.mesh(self.params[index]).vertices
        drive = self.drive
        condition, transforms = jax.tree.map(lambda leaf: leaf[index], drive)
        posed = posed_vertices(
            self.avatar.neutral_surface, condition, transforms, self.offsets == "cached"
        )
        return np.asarray(posed)

    @cached_property
    def drive(self) -> Drive:
        """Conditions and bone transforms of all frames, made on first use."""
        return drive_frames(self.avatar.fields, self.avatar.body, self.params)

    def _same_faces(self) -> None:
        if self.mode == "full":
            raise ValueError("in full mode every frame has faces of its own: iterate over meshes")


def animate(
    avatar: Avatar,
    motion: MotionLike | BodyParams,
    *,
    mode: Literal["fast", "full"] = "fast",
    offsets: Offsets = "cached",
    fps: float | None = None,
) -> Animation:
    """See `Avatar.animate`."""
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


def own_batch(avatar: Avatar, params: BodyParams, source: str) -> BodyParams:
    """Checked parameters with one batch axis and the avatar's shape in place of theirs."""
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
    """At most `wanted` frame numbers of `count`, evenly spread, first and last among them."""
    if wanted < 1:
        raise ValueError(f"{wanted} frames; at least one is needed")
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


def neutral_surface(avatar: Avatar) -> NeutralSurface:
    """What `animate` keeps of an avatar: the neutral surface, its gradients and weights."""
    neutral = canonical_params(avatar.body, jnp.asarray(avatar.betas))
    # Vertices of the extracted surface lie on its cells' planes: here on the level set itself.
    points = avatar.canonical_mesh(neutral).vertices
    fields, batch = avatar.fields, batch_size(avatar.config)
    condition = fields.geometry.condition(neutral)
    gradient = in_batches(lambda x: gradients(fields, x, condition), points, batch)
    slopes = np.maximum(np.linalg.norm(gradient, axis=1), 1e-6)
    return NeutralSurface(
        vertices=jnp.asarray(points.T),
        normals=jnp.asarray((gradient / slopes[:, None]).T),
        slopes=jnp.asarray(slopes),
        weights=jnp.asarray(in_batches(lambda x: skin_weights(fields, x), points, batch).T),
        logits=_at(fields, jnp.asarray(points)),
    )


_at = eqx.filter_jit(lambda fields, points: fields.geometry.at(points))


@eqx.filter_jit
def offset_vertices(base: NeutralSurface, condition: Any) -> Float[Array, "3 V"]:
    """The base on the surface of one condition, to first order: a step along its own normal.

    From where the condition carries it.
    """
    away = base.logits(condition) / base.slopes
    carried = base.logits.carried(condition).T
    return carried - base.normals * jnp.clip(away, -_LARGEST_STEP, _LARGEST_STEP)


@eqx.filter_jit
def posed_vertices(
    base: NeutralSurface, condition: Any, transforms: Float[Array, "J 4 4"], offset: bool
) -> Float[Array, "V 3"]:
    """Vertices of one frame, metres: offset by the frame's condition if asked, then skinned."""
    points = offset_vertices(base, condition) if offset else base.vertices
    return skin_columns(points, base.weights, transforms)


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


def posed_frame(avatar: Avatar, params: BodyParams) -> Float[np.ndarray, "V 3"]:
    """Vertices of one frame in `Animation`'s cached way, metres, for parameters without a batch.

    For poses that come one at a time: nothing is compiled for a number of frames.

    **Raises:** `ValueError` for parameters that do not fit the body.
    """
    own = own_batch(avatar, params, "parameters")[0]
    drive = _drive_frame(avatar.fields, avatar.body, own)
    return np.asarray(
        posed_vertices(avatar.neutral_surface, drive.conditions, drive.transforms, True)
    )


_drive_frame = eqx.filter_jit(
    lambda fields, body, params: Drive(
        fields.geometry.condition(params), bone_transforms(body, params)
    )
)


@eqx.filter_jit
def _drive_block(fields: AvatarFields, body: BodyModel, params: BodyParams) -> Drive:
    return jax.vmap(lambda p: _drive_frame(fields, body, p))(params)


def drive_frames(fields: AvatarFields, body: BodyModel, params: BodyParams) -> Drive:
    """Conditions and transforms of all frames, a block of frames at a time: one compilation."""
    count = len(params)
    rows = np.minimum(np.arange(-(-count // _FRAME_BLOCK) * _FRAME_BLOCK), count - 1)
    blocks = [
        _drive_block(fields, body, params[rows[k : k + _FRAME_BLOCK]])
        for k in range(0, len(rows), _FRAME_BLOCK)
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count].astype(np.float32), *blocks)
