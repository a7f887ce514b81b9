"""The `Motion` record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from jaxtyping import Float

from . import convert, editing, resampling, rotate, smoothing

if TYPE_CHECKING:
    from ..body import BodyModel, BodyParams

UpAxis = Literal["y", "z"]


@dataclass(frozen=True)
class Motion:
    """Body poses over time, in the conventions of the library.

    Attributes:
        poses: axis-angle rotation of every joint relative to its parent, radians; the first
            joint's is the orientation in the world. Hands are absolute: zero is a flat hand.
        transl: translation, metres. It is added after the body has been turned about its
            pelvis, so it is not the position of the pelvis.
        joint_names: names of the J joints.
        fps: frames a second.
        betas: shape coefficients of the person.
        expression: facial expression coefficients.
        up: the world axis that points up.
        gender: "neutral", "male", "female", or "unknown".
        source: where the motion comes from, for messages.
        notices: what was assumed or changed on the way from the source.
        template: mesh file of the person's own template, as the source names it.
        model: the body model whose joints and shape coefficients these are ("smplx", "smplh",
            "smpl"), or "unknown". Shape coefficients mean nothing to another model.

    Raises:
        ValueError: shapes do not match, a value is not finite, no frames, or a frame rate that
            is not positive.
    """

    poses: Float[np.ndarray, "T J 3"]
    transl: Float[np.ndarray, "T 3"]
    joint_names: tuple[str, ...]
    fps: float
    betas: Float[np.ndarray, " S"] = field(default_factory=lambda: np.zeros(0))
    expression: Float[np.ndarray, "T E"] | None = None
    up: UpAxis = "y"
    gender: str = "neutral"
    source: str = "motion"
    notices: tuple[str, ...] = ()
    template: str | None = None
    model: str = "unknown"

    def __post_init__(self):
        count = len(self.poses)
        expression = np.zeros((count, 0)) if self.expression is None else self.expression
        for name, value in (
            ("poses", self.poses),
            ("transl", self.transl),
            ("betas", self.betas),
            ("expression", expression),
        ):
            object.__setattr__(self, name, np.asarray(value, np.float64))
        object.__setattr__(self, "joint_names", tuple(self.joint_names))
        _check(self)
        object.__setattr__(self, "fps", float(self.fps))

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last."""
        return (len(self) - 1) / self.fps

    def __getitem__(self, index: slice) -> Motion:
        """A stretch of the motion. A step keeps every so many frames and lowers `fps`."""
        if not isinstance(index, slice) or (index.step is not None and index.step < 1):
            raise TypeError("A motion is cut with a slice whose step is positive: motion[10:50:2].")
        return replace(
            self,
            poses=self.poses[index],
            transl=self.transl[index],
            expression=self.expression[index],  # type: ignore[index]
            fps=self.fps / (index.step or 1),
        )

    def joint(self, name: str) -> Float[np.ndarray, "T 3"]:
        """Rotations of one joint by name.

        Raises:
            ValueError: the motion has no such joint.
        """
        if name not in self.joint_names:
            raise ValueError(
                f"{self.source}: no joint {name!r}; there are {', '.join(self.joint_names)}."
            )
        return self.poses[:, self.joint_names.index(name)]

    def with_notice(self, notice: str) -> Motion:
        """The same motion with one more notice."""
        return replace(self, notices=(*self.notices, notice))

    def to_params(self, body: BodyModel) -> BodyParams:
        """Parameters of `body` for every frame, joints matched by name, coefficients cut or
        filled with zeros to the body's number. What is lost is warned about (`MotionNotice`)."""
        return convert.to_params(self, body)

    @classmethod
    def from_params(
        cls,
        params: BodyParams,
        *,
        fps: float,
        up: UpAxis = "y",
        gender: str = "neutral",
        source: str = "parameters",
    ) -> Motion:
        """The motion that batched parameters describe. See `convert.from_params`."""
        return convert.from_params(params, fps=fps, up=up, gender=gender, source=source)

    def rotate(
        self,
        rotation: Float[np.ndarray, "3 3"],
        pelvis: Float[np.ndarray, 3],
        *,
        up: UpAxis | None = None,
    ) -> Motion:
        """The motion with the world turned about the origin. See `rotate.rotate_world`."""
        return rotate.rotate_world(self, rotation, pelvis, up=up)

    def to_y_up(self, body: BodyModel) -> Motion:
        """The motion in a world whose y axis points up. See `rotate.to_up`."""
        return rotate.to_up(self, body, "y")

    def to_z_up(self, body: BodyModel) -> Motion:
        """The motion in a world whose z axis points up. See `rotate.to_up`."""
        return rotate.to_up(self, body, "z")

    def resample(self, fps: float) -> Motion:
        """The motion at another frame rate. See `resampling.resample`."""
        return resampling.resample(self, fps)

    def smooth(self, seconds: float, joints: Sequence[str] | None = None) -> Motion:
        """The motion without jitter faster than about `seconds`. See `smoothing.smooth`."""
        return smoothing.smooth(self, seconds, joints)

    def trim(self, start: float = 0.0, end: float | None = None) -> Motion:
        """The frames between two times, in seconds. See `editing.trim`."""
        return editing.trim(self, start, end)


def _check(motion: Motion) -> None:
    count, joints = len(motion.poses), len(motion.joint_names)
    for name, expected in (
        ("poses", (count, joints, 3)),
        ("transl", (count, 3)),
        ("expression", (count, None)),
        ("betas", (None,)),
    ):
        shape = np.shape(getattr(motion, name))
        fits = len(shape) == len(expected) and all(
            e is None or s == e for s, e in zip(shape, expected, strict=True)
        )
        if not fits:
            wanted = tuple("any" if e is None else e for e in expected)
            raise ValueError(
                f"{motion.source}: {name} has shape {shape}, expected {wanted} "
                f"({count} frames, {joints} joint names)."
            )
        values = getattr(motion, name)
        if not np.isfinite(values).all():
            where = ""
            if values.ndim > 1:
                bad = ~np.isfinite(values.reshape(count, -1)).all(axis=1)
                where = f" in {int(bad.sum())} frames, first in frame {int(np.argmax(bad))}"
            raise ValueError(
                f"{motion.source}: {name} is not finite{where}: cut or mend those frames."
            )
    if count == 0:
        raise ValueError(f"{motion.source}: the motion has no frames.")
    if not (np.isfinite(motion.fps) and motion.fps > 0):
        raise ValueError(
            f"{motion.source}: frame rate {motion.fps}; it must be positive. Give the right one "
            "with fps=."
        )
    if motion.up not in get_args(UpAxis):
        raise ValueError(f"{motion.source}: up axis {motion.up!r}; it must be 'y' or 'z'.")
