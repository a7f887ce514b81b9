"""Frames that training can use but that look wrong: said once, with their names."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int

from ..body import BodyModel, BodyParams
from ..body.params import MAX_DEFAULT_COEFFICIENTS
from ..frames import Frame, Frames, posed_vertices
from ..geometry import nearest_vertices

MISFIT_M = 0.03
_LOOKED_AT = 500  # vertices of the body that are compared with a mesh: enough for a median
_NAMED = 8
_FEW_FOUND = 0.9


class TrainingNotice(UserWarning):
    """Something about a training run was assumed, or looks wrong."""


def notify(message: str, record: list[str] | None, *, stacklevel: int) -> None:
    """Warn (`TrainingNotice`), and add the message to the run's record, once, if there is one."""
    warnings.warn(message, TrainingNotice, stacklevel=stacklevel + 1)
    if record is not None and message not in record:
        record.append(message)


@dataclass
class FrameCheck:
    """What was seen of the frames so far; `notify` says it."""

    body: BodyModel
    misfits: list[tuple[str, float]] = field(default_factory=list)
    turned: list[str] = field(default_factory=list)
    seen: int = 0

    def look(self, frame: Frame) -> None:
        """Compare a mesh with the body in its pose, and note whether it was inside out."""
        self.seen += 1
        distance = misfit(self.body, frame)
        if distance > MISFIT_M:
            self.misfits.append((frame.source, distance))
        if frame.turned:
            self.turned.append(frame.source)

    def notify(self, record: list[str] | None) -> None:
        """Say (see `notify`) which frames do not fit, and which meshes were turned round."""
        if self.misfits:
            worst = sorted(self.misfits, key=lambda entry: -entry[1])
            names = [f"{source} ({100 * distance:.1f} cm)" for source, distance in worst]
            notify(
                f"{len(names)} of {self.seen} frames do not fit their parameters: half of the "
                f"posed body is more than {100 * MISFIT_M:.0f} cm from the mesh in "
                f"{_listed(names)}. Training goes on; leave these frames out, or look for wrong "
                "parameters, units or axes.",
                record,
                stacklevel=3,
            )
        if self.turned:
            notify(
                f"{len(self.turned)} of {self.seen} meshes were inside out and have been turned "
                f"round: {_listed(self.turned)}.",
                record,
                stacklevel=3,
            )


def misfit(body: BodyModel, frame: Frame) -> float:
    """Median distance, metres, from the body in the frame's pose to the nearest mesh vertices."""
    posed = posed_vertices(body, frame.params)
    chosen = posed[:: max(len(posed) // _LOOKED_AT, 1)]
    distance, _ = nearest_vertices(frame.vertices, chosen)
    return float(np.median(distance))


def check_expression(params: BodyParams, record: list[str] | None) -> None:
    """**Warns:** `TrainingNotice` if coefficients are used that no field of ours reads."""
    beyond = np.abs(np.asarray(params.expression)[..., MAX_DEFAULT_COEFFICIENTS:])
    if beyond.any():
        notify(
            f"expression has {params.expression.shape[-1]} coefficients, and the avatar learns the "
            f"first {MAX_DEFAULT_COEFFICIENTS}; those after them reach {beyond.max():.1f} and move "
            "the meshes alone.",
            record,
            stacklevel=4,
        )


def check_found(
    frames: Frames, found: Int[np.ndarray, " F"], points: int, record: list[str] | None
) -> None:
    """Look at how many of each frame's points have a root.

    **Raises:** `ValueError` if none of any frame has one.
    **Warns:** `TrainingNotice` naming frames without any, or if many points of all have none.
    """
    lost = [source for source, count in zip(frames.sources, found, strict=True) if not count]
    if len(lost) == len(found):
        raise ValueError(
            f"no point of any frame was found on the body: {_listed(lost)}. Meshes and parameters "
            "do not belong together; check units (metres), axes and transl."
        )
    if lost:
        notify(
            f"{len(lost)} of {len(found)} frames have no point that was found on the body, and "
            f"nothing is learned from them: {_listed(lost)}.",
            record,
            stacklevel=4,
        )
    share = found.sum() / (points * (len(found) - len(lost)))
    if share < _FEW_FOUND:
        notify(
            f"{1 - share:.0%} of the points were not found on the body, and nothing is learned "
            "there: clothes or hair may reach further from the skin than skinning weights are "
            "known.",
            record,
            stacklevel=4,
        )


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
