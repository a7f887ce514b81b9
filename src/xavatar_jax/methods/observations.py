"""The frames that a method learns from: which ones, whose shape, and whether they fit the body."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..body import BodyModel, BodyParams, with_betas
from ..body.params import MAX_DEFAULT_COEFFICIENTS
from ..frames import Frame, Frames, posed_vertices, spread
from ..geometry import nearest_vertices
from ..learning import notify
from ..sampling import varied_frames

MISFIT_M = 0.03
"""A frame whose mesh is further from the posed body than this, in the median, does not fit."""
_COMPARED = 500  # vertices of the body that are compared with a mesh: enough for a median
_NAMED = 8
_FEW_FOUND = 0.9
_LEAST_FRAMES = 24
_SAME_BETAS = 1e-3  # differences that rounding in files explains


def subject_betas(frames: Frames) -> Float[np.ndarray, " S"]:
    """The one shape of the person: the mean of the frames' betas."""
    return np.asarray(frames.params.betas).mean(0)


def with_one_shape(frames: Frames, betas: Any, notices: list[str]) -> Frames:
    """The frames with the person's shape, because there is one canonical body.

    **Warns:** `TrainingNotice` if the frames' own shapes differ.
    """
    apart = float(np.ptp(np.asarray(frames.params.betas), axis=0).max(initial=0.0))
    if apart > _SAME_BETAS:
        notify(
            f"betas differ between frames by up to {apart:.2f}. One person has one shape: their "
            "mean is used for all frames.",
            notices,
            stacklevel=4,
        )
    return frames.with_params(with_betas(frames.params, betas), frames.body)


def frames_in_budget(train_frames: int, minutes: float | None, per_minute: int) -> int:
    """How many frames to learn from (0: all): `train_frames`, or what `minutes` can label.

    The first minute is for what every run starts with: first fields, compilation, steps. The
    number does not depend on a clock, so that no draw does.
    """
    if minutes is None or not per_minute:
        return train_frames
    most = max(round((minutes - 1) * per_minute), _LEAST_FRAMES)
    return min(train_frames, most) if train_frames else most


def choose_frames(
    frames: Frames,
    *,
    train_frames: int,
    minutes: float | None,
    per_minute: int,
    held_share: float = 0.0,
    held_frames: int = 0,
    notices: list[str] | None = None,
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " v"]]:
    """Indices of the frames to learn from, chosen for their variety, and of validation frames.

    The last `held_share` of each sequence is never learned from; of these frames, `held_frames`
    spread over the sequences are for validation. A sequence of fewer than `1 / held_share` frames
    holds none out.

    **Warns:** `TrainingNotice` if the minutes leave out frames that were asked for.
    """
    rows, held = _hold_out(frames, held_share, held_frames)
    wanted = min(train_frames or len(rows), len(rows))
    count = min(frames_in_budget(train_frames, minutes, per_minute) or len(rows), len(rows))
    if count < wanted:
        notify(
            f"learning from {count} of {wanted} frames: labelling the others would take too much "
            f"of the {minutes:g} minutes (frames_per_minute={per_minute}; 0 uses all frames).",
            notices,
            stacklevel=4,
        )
    return rows[varied_frames(frames.params[rows], count)], held


def _hold_out(
    frames: Frames, share: float, count: int
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " v"]]:
    index = frames.sequence_index
    held = np.zeros(len(frames), bool)
    for sequence in np.unique(index):
        rows = np.flatnonzero(index == sequence)
        held[rows[len(rows) - int(share * len(rows) + 1e-9) :]] = True
    rows = np.flatnonzero(held)
    if not len(rows) or not count:
        return np.arange(len(frames)), np.zeros(0, np.int64)
    return np.flatnonzero(~held), rows[spread(frames[rows], count)]


def frame_digest(frame: Frame) -> str:
    """A checksum of a frame's mesh."""
    digest = hashlib.sha256(np.ascontiguousarray(frame.vertices, np.float32).tobytes())
    digest.update(np.ascontiguousarray(frame.faces, np.int32).tobytes())
    return digest.hexdigest()[:16]


def frames_digest(params: BodyParams, betas: Any, meshes: Sequence[str]) -> str:
    """A checksum of frames: their parameters, the person's shape, and their meshes."""
    digest = hashlib.sha256("".join(meshes).encode())
    for values in (params.pose, params.expression, params.transl, betas):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


@dataclass
class FrameCheck:
    """Collects frames that look wrong while they are read, and reports them together."""

    body: BodyModel
    misfits: list[tuple[str, float]] = field(default_factory=list)
    turned: list[str] = field(default_factory=list)
    seen: int = 0

    def add(self, frame: Frame) -> None:
        """Compare a mesh with the body in its pose, and note whether it was inside out."""
        self.seen += 1
        distance = misfit(self.body, frame)
        if distance > MISFIT_M:
            self.misfits.append((frame.source, distance))
        if frame.turned:
            self.turned.append(frame.source)

    def report(self, record: list[str] | None) -> None:
        """**Warns:** `TrainingNotice` naming misfits, and meshes that were turned inside out."""
        if self.misfits:
            worst = sorted(self.misfits, key=lambda entry: -entry[1])
            names = [f"{source} ({100 * distance:.1f} cm)" for source, distance in worst]
            notify(
                f"{len(names)} of {self.seen} frames do not fit their parameters: half of the "
                f"posed body is more than {100 * MISFIT_M:.0f} cm from the mesh in "
                f"{_listed(names)}. Training continues; leave these frames out, or check "
                "parameters, units and axes.",
                record,
                stacklevel=3,
            )
        if self.turned:
            notify(
                f"{len(self.turned)} of {self.seen} meshes were inside out, and their triangles "
                f"were reversed: {_listed(self.turned)}.",
                record,
                stacklevel=3,
            )


def misfit(body: BodyModel, frame: Frame) -> float:
    """Median distance, metres, from the body in the frame's pose to the nearest mesh vertices."""
    posed = posed_vertices(body, frame.params)
    chosen = posed[:: max(len(posed) // _COMPARED, 1)]
    distance, _ = nearest_vertices(frame.vertices, chosen)
    return float(np.median(distance))


def check_expression(params: BodyParams, record: list[str] | None) -> None:
    """**Warns:** `TrainingNotice` if coefficients are used that no field reads."""
    beyond = np.abs(np.asarray(params.expression)[..., MAX_DEFAULT_COEFFICIENTS:])
    if beyond.any():
        notify(
            f"expression has {params.expression.shape[-1]} coefficients. The avatar learns the "
            f"first {MAX_DEFAULT_COEFFICIENTS}; the others reach {beyond.max():.1f} and still move "
            "the meshes.",
            record,
            stacklevel=4,
        )


def check_found(
    sources: Sequence[str], found: Int[np.ndarray, " F"], points: int, record: list[str] | None
) -> None:
    """Check how many of each frame's points have a root.

    **Raises:** `ValueError` if no point of any frame has one.
    **Warns:** `TrainingNotice` naming frames without any, or if many points have none.
    """
    lost = [source for source, count in zip(sources, found, strict=True) if not count]
    if len(lost) == len(found):
        raise ValueError(
            f"no point of any frame could be mapped to the body: {_listed(lost)}. Meshes and "
            "parameters do not match; check units (metres), axes and transl."
        )
    if lost:
        notify(
            f"{len(lost)} of {len(found)} frames have no point that could be mapped to the body, "
            f"and are not learned from: {_listed(lost)}.",
            record,
            stacklevel=4,
        )
    share = found.sum() / (points * (len(found) - len(lost)))
    if share < _FEW_FOUND:
        notify(
            f"{1 - share:.0%} of the points could not be mapped to the body, and are not learned "
            "from: clothes or hair may be further from the skin than the skinning weights reach.",
            record,
            stacklevel=4,
        )


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
