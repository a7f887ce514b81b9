"""Posed surfaces and their colours, as requested by the viewer's panel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import ArrayLike

from ..avatar import Drivable, posed_frame, spread_frames
from ..body import BodyParams
from ..body.joints import pose_groups
from ..frames import Frames
from ..geometry import closest_points, vertex_normals
from ..kinematics import KinematicTree
from ..render import SKIN_COLOR, TRUTH_COLOR, error_colors, weight_colors

UpAxis = Literal["y", "z"]
UP: dict[str, tuple[float, float, float]] = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
AVATAR, NORMALS, WEIGHTS = "avatar", "normals", "skinning weights"
TRUTH, ERROR = "ground truth", "error"


@dataclass(frozen=True)
class Request:
    """What the panel asks for.

    - `frame`: index in the motion.
    - `shading`: one of `Surfaces.shadings`.
    - `bone`: whose weights to show; None shows all bones in their own colours.
    - `turns`: joints and axis-angles (radians) on top of the frame's pose.
    - `expression`: added to the frame's.
    - `in_place`: remove the motion's movement along the ground.
    """

    frame: int = 0
    shading: str = AVATAR
    bone: int | None = None
    turns: tuple[tuple[int, tuple[float, float, float]], ...] = ()
    expression: tuple[float, ...] = ()
    in_place: bool = False


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh to show, metres, in one colour (sRGB, 0 to 1) or with vertex colours.

    - `note`: text for the panel.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    color: tuple[float, float, float] = SKIN_COLOR
    colors: UInt8[np.ndarray, "V 3"] | None = None
    note: str = ""


@dataclass(frozen=True)
class Surfaces:
    """An avatar in a motion, with ground truth if there are frames.

    - `params`: of the T frames, NumPy arrays.
    - `up`: the world's up axis, a unit vector.
    - `max_error_mm`: distance shown in red.
    """

    avatar: Drivable
    params: BodyParams
    frames: Frames | None
    up: Float[np.ndarray, "3"]
    max_error_mm: float

    @property
    def shadings(self) -> tuple[str, ...]:
        """The available shadings."""
        return (AVATAR, NORMALS, WEIGHTS, *((TRUTH, ERROR) if self.frames is not None else ()))

    def template(self, frame: int) -> Surface:
        """The body in a frame's pose, shown until the avatar's surface is ready."""
        vertices = self.avatar.posed_template(frame_of(self.params, frame))
        return Surface(vertices.astype(np.float32), np.asarray(self.avatar.body.faces))

    def ground_height(self) -> float:
        """Height of the lowest body vertex in some frames of the motion."""
        some = spread_frames(len(self.params), 6)
        return float(min((self.template(int(k)).vertices @ self.up).min() for k in some))

    def __call__(self, request: Request) -> Surface:
        """The requested surface. Ground truth and error use the frame's own pose."""
        own = frame_of(self.params, request.frame)
        shift = self._shift(request.frame) if request.in_place else np.zeros(3, np.float32)
        if request.shading in (TRUTH, ERROR):
            return self._against_truth(request, own, shift)
        vertices = posed_frame(
            self.avatar, turned(own, dict(request.turns), np.asarray(request.expression))
        )
        vertices, faces = vertices - shift, self.avatar.rest.faces
        colors = self.avatar.rest.colors
        colors = None if colors is None else np.asarray(colors)[:, :3]
        if request.shading == NORMALS:
            normals = vertex_normals(vertices, faces)
            colors = np.round(255 * (0.5 + 0.5 * normals)).astype(np.uint8)
        elif request.shading == WEIGHTS:
            colors = weight_colors(np.asarray(self.avatar.rest.weights).T, request.bone)
        return Surface(vertices, faces, colors=colors)

    def _against_truth(
        self, request: Request, own: BodyParams, shift: Float[np.ndarray, "3"]
    ) -> Surface:
        assert self.frames is not None
        truth = self.frames[request.frame]
        if request.shading == TRUTH:
            return Surface(truth.vertices - shift, truth.faces, TRUTH_COLOR)
        vertices, faces = posed_frame(self.avatar, own), self.avatar.rest.faces
        distance = 1000 * closest_points(truth.vertices, truth.faces, vertices)[0]
        return Surface(
            vertices - shift,
            faces,
            colors=error_colors(distance, self.max_error_mm),
            note=f"distance to the ground truth: mean {distance.mean():.2f} mm, "
            f"maximum {distance.max():.1f} mm",
        )

    def _shift(self, frame: int) -> Float[np.ndarray, "3"]:
        """Movement of the root along the ground since the first frame."""
        transl = np.asarray(self.params.transl, np.float64)
        way = transl[frame] - transl[0]
        return (way - (way @ self.up) * self.up).astype(np.float32)


def rest_params(avatar: Drivable) -> BodyParams:
    """One frame, batched `(1, ...)`: the avatar's shape in the body's rest pose."""
    return BodyParams.create(
        avatar.body, transl=np.zeros((1, 3)), betas=np.asarray(avatar.betas)[None]
    )


def turned(
    params: BodyParams,
    turns: Mapping[int, ArrayLike | tuple[float, ...]],
    expression: Float[np.ndarray, " E"] | None = None,
) -> BodyParams:
    """Turn joints of one frame further and add to its expression.

    Args:
        params: of one frame, `(J, 3)`.
        turns: for each joint, a rotation applied before the frame's own, axis-angle in radians.
        expression: added to the first coefficients.
    """
    from scipy.spatial.transform import Rotation

    pose = np.array(params.pose, np.float64)
    for joint, turn in turns.items():
        own = Rotation.from_rotvec(pose[joint]) * Rotation.from_rotvec(np.asarray(turn, float))
        pose[joint] = own.as_rotvec()
    coefficients = np.array(params.expression, np.float64)
    if expression is not None:
        count = min(len(expression), len(coefficients))
        coefficients[:count] += np.asarray(expression)[:count]
    dtype = params.pose.dtype
    return replace(
        params, pose=jnp.asarray(pose, dtype), expression=jnp.asarray(coefficients, dtype)
    )


def joint_choices(tree: KinematicTree) -> dict[str, dict[str, tuple[int, ...]]]:
    """The joints that each group of sliders offers: single joints, all fingers, both eyes.

    Groups without joints are left out.
    """
    groups = pose_groups(tree)
    names = tree.names

    def single(joints: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
        return {names[j].replace("_", " "): (j,) for j in joints}

    out = {"Body": single((*groups["global_orient"], *groups["body_pose"]))}
    for side in ("left", "right"):
        joints = groups[f"{side}_hand_pose"]
        fingers = tuple(j for j in joints if "thumb" not in names[j])
        together = {"all fingers": fingers} if fingers else {}
        out[f"{side.capitalize()} hand"] = {**together, **single(joints)}
    eyes = (*groups["leye_pose"], *groups["reye_pose"])
    both = {"both eyes": eyes} if len(eyes) > 1 else {}
    out["Jaw and eyes"] = {**single(groups["jaw_pose"]), **both}
    return {name: choices for name, choices in out.items() if choices}


def frame_of(params: BodyParams, index: int) -> BodyParams:
    """One frame of batched parameters, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], params)
