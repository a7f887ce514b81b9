"""What the viewer shows for what its panel asks: a posed surface and its colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from ..avatar import Avatar
from ..avatar.animate import posed_frame, spread_frames
from ..body import BodyParams
from ..frames import Frames
from ..geometry import closest_points, vertex_normals
from ..render import SKIN_COLOR, TRUTH_COLOR, error_colors, weight_colors
from .poses import frame_of, turned

AVATAR, NORMALS, WEIGHTS, TRUTH, ERROR = (
    "avatar",
    "normals",
    "skinning weights",
    "ground truth",
    "error",
)


@dataclass(frozen=True)
class Wish:
    """What the panel asks for.

    - `frame`: number in the motion.
    - `shading`: one of `shadings`.
    - `bone`: whose weights, or None for all in their own colours.
    - `turns`: joint and axis-angle, radians, on top of the frame's pose.
    - `expression`: added to the frame's.
    - `in_place`: without the motion's way along the ground.
    """

    frame: int = 0
    shading: str = AVATAR
    bone: int | None = None
    turns: tuple[tuple[int, tuple[float, float, float]], ...] = ()
    expression: tuple[float, ...] = ()
    in_place: bool = False


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh to show: in one colour (sRGB, 0 to 1), or with a colour a vertex. Metres.

    - `note`: what is to be said of it.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    color: tuple[float, float, float] = SKIN_COLOR
    colors: UInt8[np.ndarray, "V 3"] | None = None
    note: str = ""


@dataclass(frozen=True)
class Surfaces:
    """An avatar under a motion, with ground truth where there are frames.

    - `params`: of the T frames, NumPy arrays.
    - `up`: the world's up axis, a unit vector.
    """

    avatar: Avatar
    params: BodyParams
    frames: Frames | None
    up: Float[np.ndarray, "3"]
    max_error_mm: float

    @property
    def shadings(self) -> tuple[str, ...]:
        """What can be shown."""
        return (AVATAR, NORMALS, WEIGHTS, *((TRUTH, ERROR) if self.frames is not None else ()))

    def template(self, frame: int) -> Surface:
        """The body itself in a frame's pose: shown until the avatar's surface is there."""
        vertices = self.avatar.posed_template(frame_of(self.params, frame))
        return Surface(vertices.astype(np.float32), np.asarray(self.avatar.body.faces))

    def ground_height(self) -> float:
        """The lowest point of the body in some frames of the motion, along the up axis."""
        some = spread_frames(len(self.params), 6)
        return float(min((self.template(int(k)).vertices @ self.up).min() for k in some))

    def __call__(self, wish: Wish) -> Surface:
        """The surface asked for. Ground truth and error take the frame's own pose."""
        own = frame_of(self.params, wish.frame)
        shift = self._shift(wish.frame) if wish.in_place else np.zeros(3, np.float32)
        if wish.shading in (TRUTH, ERROR):
            return self._against_truth(wish, own, shift)
        vertices = posed_frame(
            self.avatar, turned(own, dict(wish.turns), np.asarray(wish.expression))
        )
        vertices, faces = vertices - shift, self.avatar.canonical_mesh().faces
        colors = None
        if wish.shading == NORMALS:
            normals = vertex_normals(vertices, faces)
            colors = np.round(255 * (0.5 + 0.5 * normals)).astype(np.uint8)
        elif wish.shading == WEIGHTS:
            colors = weight_colors(np.asarray(self.avatar.neutral_surface.weights).T, wish.bone)
        return Surface(vertices, faces, colors=colors)

    def _against_truth(self, wish: Wish, own: BodyParams, shift: Float[np.ndarray, "3"]) -> Surface:
        assert self.frames is not None
        truth = self.frames[wish.frame]
        if wish.shading == TRUTH:
            return Surface(truth.vertices - shift, truth.faces, TRUTH_COLOR)
        vertices, faces = posed_frame(self.avatar, own), self.avatar.canonical_mesh().faces
        distance = 1000 * closest_points(truth.vertices, truth.faces, vertices)[0]
        return Surface(
            vertices - shift,
            faces,
            colors=error_colors(distance, self.max_error_mm),
            note=f"distance to the ground truth: {distance.mean():.2f} mm on average, "
            f"{distance.max():.1f} mm at most",
        )

    def _shift(self, frame: int) -> Float[np.ndarray, "3"]:
        """How far a frame's root has gone from the first frame's, along the ground."""
        transl = np.asarray(self.params.transl, np.float64)
        way = transl[frame] - transl[0]
        return (way - (way @ self.up) * self.up).astype(np.float32)
