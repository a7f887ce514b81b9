"""Pinhole cameras, and cameras placed so that a mesh fills the picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..geometry import check_points

Vector = np.ndarray | Sequence[float | int]

_VIEWS = {"front": 0.0, "three_quarter": 35.0, "left": 90.0, "back": 180.0, "right": -90.0}


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in OpenCV's convention: x right, y down, z forward.

    Attributes:
        position: centre of projection (3,), metres, world frame.
        rotation: world to camera (3, 3): x_camera = rotation @ (x_world - position).
        fov: vertical field of view, radians.
        up: the world's up direction (3,), for the ground and the lights.
    """

    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    fov: float
    up: Float[np.ndarray, "3"]

    @classmethod
    def look_at(
        cls,
        position: Vector,
        target: Vector,
        *,
        up: Vector = (0.0, 1.0, 0.0),
        fov: float = math.radians(25.0),
    ) -> "Camera":
        """A camera at `position` (3,) that looks at `target` (3,), metres, with `up` pointing up.

        Raises:
            ValueError: if position and target coincide, or `fov` is not within (0, pi).
        """
        eye, aim, upward = (np.asarray(v, dtype=np.float64) for v in (position, target, up))
        forward = aim - eye
        if not np.linalg.norm(forward) > 0:
            raise ValueError(f"the camera's position and target coincide at {eye.tolist()}.")
        if not 0 < fov < math.pi:
            raise ValueError(f"fov must be between 0 and pi radians, found {fov}.")
        forward /= np.linalg.norm(forward)
        upward = upward / np.linalg.norm(upward)
        right = np.cross(forward, upward)
        if np.linalg.norm(right) < 1e-6:
            # Looking along up: any right is valid.
            right = np.cross(forward, np.roll(upward, 1))
        right /= np.linalg.norm(right)
        return cls(eye, np.stack([right, np.cross(forward, right), forward]), fov, upward)

    def rays(
        self,
        width: int,
        height: int,
        rows: slice = slice(None),
        columns: slice = slice(None),
        supersample: int = 1,
    ) -> Float[np.ndarray, "H W 3"]:
        """World directions through the pixel centres, depth 1 along the optical axis, float32.

        `rows` and `columns` select a window, in blocks of `supersample` pixels.
        """
        scale = 2.0 * math.tan(0.5 * self.fov) / height
        x = (np.arange(width) + 0.5 - 0.5 * width).reshape(-1, supersample)[columns].reshape(-1)
        y = (np.arange(height) + 0.5 - 0.5 * height).reshape(-1, supersample)[rows].reshape(-1)
        right, down, forward = self.rotation.astype(np.float32)
        x, y = (scale * x).astype(np.float32), (scale * y).astype(np.float32)
        return (x[:, None] * right + forward) + (y[:, None] * down)[:, None]

    def project(self, points: ArrayLike, width: int, height: int) -> Float[np.ndarray, "N 3"]:
        """Pixel coordinates (u, v) and depth (metres) of world points (N, 3).

        Pixel (row i, column j) has its centre at u = j + 0.5, v = i + 0.5.
        """
        seen = (check_points(points) - self.position) @ self.rotation.T
        focal = 0.5 * height / math.tan(0.5 * self.fov)
        u = focal * seen[:, 0] / seen[:, 2] + 0.5 * width
        v = focal * seen[:, 1] / seen[:, 2] + 0.5 * height
        return np.stack([u, v, seen[:, 2]], axis=1)


def frame_view(
    points: ArrayLike,
    view: str = "front",
    *,
    aspect: float = 1.0,
    margin: float = 1.08,
    up: Vector = (0.0, 1.0, 0.0),
    forward: Vector = (0.0, 0.0, 1.0),
    elevation: float = math.radians(6.0),
    fov: float = math.radians(22.0),
) -> Camera:
    """A camera that shows all `points` (N, 3) of a person facing `forward`.

    Args:
        points: what the picture must contain, metres.
        view: "front", "three_quarter" (the person's left), "left", "back" or "right".
        aspect: width of the picture over its height.
        margin: size of the picture over that of the points; 1 leaves no room.
        up: the world's up direction.
        forward: the direction that the person faces.
        elevation: how far above the horizon the camera stands, radians.
        fov: vertical field of view, radians.

    Raises:
        ValueError: if there is no such view, or there are no points.
    """
    if view not in _VIEWS:
        raise ValueError(f"no view {view!r}: choose one of {', '.join(_VIEWS)}.")
    vertical, ahead, left = _ground_axes(up, forward)
    angle = math.radians(_VIEWS[view])
    level = math.cos(angle) * ahead + math.sin(angle) * left
    direction = math.cos(elevation) * level + math.sin(elevation) * vertical
    return _fit(check_points(points), direction, vertical, fov, aspect, margin)


def part_view(
    points: ArrayLike,
    direction: Vector | None = None,
    *,
    aspect: float = 1.0,
    margin: float = 1.1,
    up: Vector = (0.0, 1.0, 0.0),
    forward: Vector = (0.0, 0.0, 1.0),
    fov: float = math.radians(22.0),
) -> Camera:
    """A close-up of `points` (N, 3); `direction` (3,) points from them to the camera.

    Without a direction, a flat part such as a hand is shown from its broad side that faces
    `forward` and `up` more. From steeply above or below, `forward` is up in the picture. Other
    arguments are those of `frame_view`.

    Raises:
        ValueError: if there are no points.
    """
    checked = check_points(points)
    if len(checked) == 0:
        raise ValueError("no points to look at: the part is empty.")
    vertical = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    if direction is None:
        centred = checked - checked.mean(axis=0)
        thin = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        wanted = np.asarray(forward, dtype=np.float64) + vertical
        toward = thin if thin @ wanted >= 0 else -thin
    else:
        toward = np.asarray(direction, dtype=np.float64)
    toward = toward / np.linalg.norm(toward)
    if abs(toward @ vertical) > 0.8:
        vertical = np.asarray(forward, dtype=np.float64)
    return _fit(checked, toward, vertical, fov, aspect, margin)


def orbit_views(
    points: ArrayLike,
    count: int,
    *,
    aspect: float = 1.0,
    margin: float = 1.08,
    up: Vector = (0.0, 1.0, 0.0),
    forward: Vector = (0.0, 0.0, 1.0),
    elevation: float = math.radians(8.0),
    fov: float = math.radians(22.0),
) -> list[Camera]:
    """`count` cameras on a circle around `points` (N, 3), at equal distance, the first in front.

    Every picture contains all points. The camera moves to the person's left first. Other arguments
    are those of `frame_view`.

    Raises:
        ValueError: if there are no points.
    """
    checked = check_points(points)
    vertical, ahead, left = _ground_axes(up, forward)
    ways = [
        math.cos(elevation) * (math.cos(turn) * ahead + math.sin(turn) * left)
        + math.sin(elevation) * vertical
        for turn in 2.0 * math.pi * np.arange(count) / count
    ]
    if len(checked) == 0:
        raise ValueError("no points to look at: there is nothing to frame.")
    middle = 0.5 * (checked.min(axis=0) + checked.max(axis=0))
    slopes = math.tan(0.5 * fov) / margin * np.array([aspect, 1.0])
    distance = 1e-3
    for way in ways:
        seen = (checked - middle) @ Camera.look_at(middle + way, middle, up=up).rotation.T
        distance = max(distance, _distance(seen, slopes))
    return [Camera.look_at(middle + distance * way, middle, up=up, fov=fov) for way in ways]


def _ground_axes(up: Vector, forward: Vector) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors up, forward in the plane of the ground, and to the person's left."""
    vertical = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    ahead = np.asarray(forward, dtype=np.float64)
    ahead = ahead - (ahead @ vertical) * vertical
    ahead /= np.linalg.norm(ahead)
    return vertical, ahead, np.cross(vertical, ahead)


def _distance(seen: Float[np.ndarray, "N 3"], slopes: Float[np.ndarray, "2"]) -> float:
    """The distance from the middle at which everything seen fits into the picture."""
    return float((np.abs(seen[:, :2]) / slopes - seen[:, 2:]).max())


def _fit(
    points: Float[np.ndarray, "N 3"],
    direction: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    fov: float,
    aspect: float,
    margin: float,
) -> Camera:
    """The nearest camera along `direction` whose picture contains all points."""
    if len(points) == 0:
        raise ValueError("no points to look at: there is nothing to frame.")
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    slopes = math.tan(0.5 * fov) / margin * np.array([aspect, 1.0])
    for _ in range(3):
        camera = Camera.look_at(middle + direction, middle, up=up, fov=fov)
        seen = (points - middle) @ camera.rotation.T
        distance = _distance(seen, slopes)
        # Centre the projected points, not the box: perspective shifts them.
        plane = seen[:, :2] / np.maximum(seen[:, 2:] + distance, 1e-9)
        shift = 0.5 * (plane.min(axis=0) + plane.max(axis=0)) * distance
        middle = middle + shift @ camera.rotation[:2]
    seen = (points - middle) @ camera.rotation.T
    distance = _distance(seen, slopes)
    return Camera.look_at(middle + max(distance, 1e-3) * direction, middle, up=up, fov=fov)
