"""The `Motion` record: body poses over time, and their conversion to and from body parameters."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..body import BodyModel, BodyParams, rest_joints
from ..body.params import MAX_DEFAULT_COEFFICIENTS
from ..kinematics import TO_Y_UP
from .rotations import interpolate, mean_over_time, smoothing_window, turn_first

UpAxis = Literal["y", "z"]
# Rotations from one up axis to the other, about x.
_TO_UP = {"y": TO_Y_UP["z"], "z": TO_Y_UP["z"].T}


class MotionNotice(UserWarning):
    """Part of a motion was assumed, filled in, cut or left out."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Body poses over time, in the conventions of the library.

    Motions are compared by identity, since they hold arrays.

    Attributes:
        poses: axis-angle rotation of every joint relative to its parent, radians; the first
            joint's is the orientation in the world. Hands are absolute: zero is a flat hand.
        transl: translation, metres. It is added after the body has been turned about its
            pelvis, so it is not the position of the pelvis.
        joint_names: names of the J joints.
        fps: frames per second.
        betas: shape coefficients of the person.
        expression: facial expression coefficients.
        up: the world axis that points up.
        gender: "neutral", "male", "female", or "unknown".
        source: where the motion comes from, for messages.
        notices: what was assumed or changed when the source was read.
        template: mesh file of the person's own template, as named by the source.
        model: the body model of the joints and shape coefficients ("smplx", "smplh", "smpl"), or
            "unknown". Shape coefficients have no meaning for another model.

    Raises:
        ValueError: shapes do not match, a value is not finite, there are no frames, or the frame
            rate is not positive.
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
        """A range of frames. A step keeps every n-th frame and lowers `fps`."""
        if not isinstance(index, slice) or (index.step is not None and index.step < 1):
            raise TypeError("A motion takes slices with a positive step, such as motion[10:50:2].")
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
        """Parameters of `body` for every frame, as `fit_to_body` gives them.

        What is lost is reported as a warning (`MotionNotice`).
        """
        params, notices = fit_to_body(self, body)
        for notice in notices:
            warnings.warn(notice, MotionNotice, stacklevel=2)
        return params

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
        """The motion given by parameters batched over T frames of one person.

        Args:
            params: the parameters.
            fps: frames per second.
            up: the world axis that points up.
            gender: of the body the parameters are for.
            source: name for messages.

        Raises:
            ValueError: the parameters have no single batch axis, or betas differ between frames.
        """
        pose = np.asarray(params.pose, np.float64)
        if pose.ndim != 3:
            raise ValueError(f"{source}: pose has shape {pose.shape}, expected (T, J, 3).")
        betas = np.asarray(params.betas, np.float64).reshape(len(pose), -1)
        difference = np.abs(betas - betas[:1]).max(initial=0.0)
        if difference > 1e-5:
            raise ValueError(
                f"{source}: betas differ between frames by up to {difference:.3g}; a motion has "
                "one shape. Use the same betas for all frames, for example their mean."
            )
        return cls(
            poses=pose,
            transl=np.asarray(params.transl),
            joint_names=params.tree.names,
            fps=fps,
            betas=betas[0],
            expression=np.asarray(params.expression),
            up=up,
            gender=gender,
            source=source,
        )

    def rotate(
        self,
        rotation: Float[np.ndarray, "3 3"],
        pelvis: Float[np.ndarray, 3],
        *,
        up: UpAxis | None = None,
    ) -> Motion:
        r"""The motion with the world rotated about its origin.

        A body turns about its rest pelvis $p$, not about the origin: posed vertices are
        $R_g (v - p) + p + t$. Rotating the world by $R$ therefore changes both the orientation,
        $R_g' = R R_g$, and the translation, $t' = R (t + p) - p$.

        Args:
            rotation: $R$, a rotation matrix.
            pelvis: $p$, as `rest_pelvis` gives it for the motion's betas.
            up: the axis that points up afterwards; None keeps the motion's.

        Raises:
            ValueError: `rotation` is not a rotation.
        """
        rotation, pelvis = np.asarray(rotation, np.float64), np.asarray(pelvis, np.float64)
        square = rotation.shape == (3, 3)
        error = np.abs(rotation @ rotation.T - np.eye(3)).max() if square else np.inf
        if not error < 1e-5 or np.linalg.det(rotation) < 0:
            raise ValueError(f"Not a rotation matrix (shape {rotation.shape}, error {error:.2g}).")
        transl = (self.transl + pelvis) @ rotation.T - pelvis
        poses = turn_first(self.poses, rotation)
        return replace(self, poses=poses, transl=transl, up=up or self.up)

    def to_y_up(self, body: BodyModel) -> Motion:
        """The motion in a world whose y axis points up; x stays. `body` gives the pelvis."""
        return self._to_up(body, "y")

    def to_z_up(self, body: BodyModel) -> Motion:
        """The motion in a world whose z axis points up; x stays. `body` gives the pelvis."""
        return self._to_up(body, "z")

    def _to_up(self, body: BodyModel, up: UpAxis) -> Motion:
        if self.up == up:
            return self
        return self.rotate(_TO_UP[up], pelvis_of(self, body), up=up)

    def resample(self, fps: float) -> Motion:
        """The motion at another frame rate, from the first frame up to the last.

        Rotations follow the shortest arc between neighbouring frames (slerp), the rest is linear.

        Raises:
            ValueError: `fps` is not positive.
        """
        if not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"Cannot resample to {fps} frames per second; it must be positive.")
        if fps == self.fps:
            return self
        count = int(np.floor(self.seconds * fps + 1e-6)) + 1
        return self.sampled(np.arange(count) / fps * self.fps, fps)

    def sampled(self, position: Float[np.ndarray, " N"], fps: float) -> Motion:
        """The motion at positions counted in frames; beyond the last frame, the last frame."""
        position = np.minimum(position, len(self) - 1)
        before = np.minimum(position.astype(np.int64), max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        weight = position - before

        def linear(values: np.ndarray) -> np.ndarray:
            return (1 - weight[:, None]) * values[before] + weight[:, None] * values[after]

        return replace(
            self,
            poses=interpolate(self.poses[before], self.poses[after], weight),
            transl=linear(self.transl),
            expression=linear(np.asarray(self.expression)),
            fps=float(fps),
        )

    def smooth(self, seconds: float, joints: Sequence[str] | None = None) -> Motion:
        r"""The motion with jitter faster than about `seconds` removed.

        Every frame becomes the mean of its neighbours under a Gaussian window with standard
        deviation `seconds`. Rotations are averaged as rotations (`mean_over_time`). Towards the
        ends the window narrows, so that the first and the last frame do not change and steady
        motion stays steady.

        Args:
            seconds: standard deviation of the window.
            joints: smooth only these joints, and neither translation nor expression; None
                smooths everything.

        Raises:
            ValueError: `seconds` is negative, or a joint is not in the motion.
        """
        if not (np.isfinite(seconds) and seconds >= 0):
            raise ValueError(f"Cannot smooth over {seconds} seconds; it must be zero or more.")
        unknown = [name for name in joints or () if name not in self.joint_names]
        if unknown:
            raise ValueError(f"{self.source}: no joint {', '.join(unknown)} to smooth.")
        weights = smoothing_window(len(self), seconds * self.fps)
        if len(weights) == 1:
            return self
        chosen = [j for j, name in enumerate(self.joint_names) if joints is None or name in joints]
        poses = self.poses.copy()
        poses[:, chosen] = mean_over_time(self.poses[:, chosen], weights, rotations=True)
        if joints is not None:
            return replace(self, poses=poses)
        return replace(
            self,
            poses=poses,
            transl=mean_over_time(self.transl, weights),
            expression=mean_over_time(np.asarray(self.expression), weights),
        )

    def trim(self, start: float = 0.0, end: float | None = None) -> Motion:
        """The frames from `start` to `end`, both included, in seconds from the first frame.

        Args:
            start, end: seconds; None is the end of the motion.

        Raises:
            ValueError: no frame lies between them.
        """
        last = self.seconds if end is None else end
        # A frame that rounding puts just outside counts as inside.
        index = np.arange(len(self))
        inside = (index >= start * self.fps - 1e-6) & (index <= last * self.fps + 1e-6)
        if not inside.any():
            raise ValueError(
                f"{self.source}: no frame between {start:g} and {last:g} seconds; the motion runs "
                f"from 0 to {self.seconds:g}."
            )
        kept = np.flatnonzero(inside)
        return self[int(kept[0]) : int(kept[-1]) + 1]


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
                f"{motion.source}: {name} is not finite{where}: cut or repair those frames."
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


# Motions on a body


def rest_pelvis(body: BodyModel, betas: Float[np.ndarray, " S"]) -> Float[np.ndarray, 3]:
    """Position of the root joint at rest for one shape: the point a body turns about.

    Args:
        body: the body model.
        betas: shape coefficients, cut to the body's number.
    """
    fitted = jnp.asarray(betas[: body.num_betas], float)
    return np.asarray(rest_joints(body, fitted)[0], np.float64)


def pelvis_of(motion: Motion, body: BodyModel) -> Float[np.ndarray, 3]:
    """`rest_pelvis` in the motion's shape, or in the mean shape if that is of another model."""
    return rest_pelvis(body, shape_for(motion, body)[0])


def shape_for(motion: Motion, body: BodyModel) -> tuple[Float[np.ndarray, " S"], str | None]:
    """The motion's shape coefficients if they are of the body's model, else none and a notice."""
    if motion.model in ("unknown", body.kind) or not motion.betas.any():
        return motion.betas, None
    return np.zeros(0), (
        f"{motion.source}: betas are of {motion.model} and have no meaning for the {body.kind} "
        "body; its mean shape is used."
    )


def fit_size(
    values: Float[np.ndarray, "*batch n"],
    limit: int,
    name: str,
    source: str,
    holder: str = "the body",
) -> tuple[Float[np.ndarray, "*batch m"], str | None]:
    """Cut the last axis to `limit`, or pad it with zeros to ten if `limit` allows.

    Only cutting coefficients that are not zero changes a body, and gives a notice.
    """
    found = values.shape[-1]
    if found <= limit:
        missing = max(min(MAX_DEFAULT_COEFFICIENTS, limit) - found, 0)
        return np.concatenate([values, np.zeros((*values.shape[:-1], missing))], -1), None
    notice = None
    if np.any(values[..., limit:] != 0):
        notice = (
            f"{source}: {found} {name} given, {holder} has {limit}; the last {found - limit} cut."
        )
    return values[..., :limit], notice


def fit_to_body(motion: Motion, body: BodyModel) -> tuple[BodyParams, list[str]]:
    """Parameters of `body` for every frame, joints matched by name, and notices of what is lost.

    Joints of the body that the motion lacks stay at zero. Coefficients are cut or padded to the
    body's number.

    Args:
        motion: the motion. Its world is kept: use `Motion.to_y_up` first if it is z-up.
        body: the body.

    Raises:
        ValueError: the motion and the body have no joint in common.
    """
    names = body.tree.names
    shared = [name for name in names if name in motion.joint_names]
    if not shared:
        raise ValueError(
            f"{motion.source}: no joint of the motion ({', '.join(motion.joint_names[:4])}, ...) "
            f"is a joint of the body ({', '.join(names[:4])}, ...)."
        )
    pose = np.zeros((len(motion), len(names), 3))
    for name in shared:
        pose[:, names.index(name)] = motion.joint(name)
    notices = []
    missing = [name for name in names if name not in shared]
    if missing:
        notices.append(
            f"{motion.source}: no rotations for {len(missing)} joints of the body "
            f"({_first_names(missing)}); they stay at zero."
        )
    dropped = [n for n in motion.joint_names if n not in names and np.any(motion.joint(n))]
    if dropped:
        notices.append(
            f"{motion.source}: {len(dropped)} moving joints are not in the body "
            f"({_first_names(dropped)}); they are left out."
        )
    betas, model_notice = shape_for(motion, body)
    betas, betas_notice = fit_size(betas, body.num_betas, "betas", motion.source)
    expression, expression_notice = fit_size(
        np.asarray(motion.expression), body.num_expression, "expression coefficients", motion.source
    )
    notices += [n for n in (model_notice, betas_notice, expression_notice) if n]
    params = BodyParams(
        pose=jnp.asarray(pose, float),
        betas=jnp.asarray(np.broadcast_to(betas, (len(motion), len(betas))), float),
        expression=jnp.asarray(expression, float),
        transl=jnp.asarray(motion.transl, float),
        tree=body.tree,
    )
    return params, notices


def _first_names(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
