"""Signed-distance-like primitives and their smooth combinations.

Every primitive maps points (N, 3) to values (N,): negative inside, and approximately the distance
in metres near the surface, which is the zero level.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, " N"]
Points = Float[np.ndarray, "N 3"]
Vector = Sequence[float] | np.ndarray
Field = Callable[[np.ndarray], np.ndarray]


def offset(point: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    """The point moved by (x, y, z)."""
    return point + np.array([x, y, z])


def on_grid(p: Points) -> Points:
    """Points rounded to multiples of 2**-21 m, which float32 represents exactly.

    The last bits of powers and exponentials depend on the processor. Without rounding, remeshing,
    which compares lengths, would produce different meshes.
    """
    return np.rint(p * 2.0**21) * 2.0**-21


def bump(p: Points, centre: Vector, radii: Vector) -> Values:
    """A Gaussian of height 1 with standard deviations `radii` along the axes."""
    q = (p - np.asarray(centre)) / np.asarray(radii)
    return np.exp(-0.5 * (q * q).sum(1))


def smooth_min(a: Values, b: Values, radius: float) -> Values:
    """Union with a fillet of about `radius` (polynomial smooth minimum)."""
    blend = np.maximum(radius - np.abs(a - b), 0.0)
    return np.minimum(a, b) - blend * blend * (0.25 / radius)


def smooth_max(a: Values, b: Values, radius: float) -> Values:
    """Intersection with a rounded edge of about `radius`."""
    return -smooth_min(-a, -b, radius)


def carve(a: Values, tool: Values, radius: float) -> Values:
    """Remove `tool` from `a`, with the rim rounded by `radius`."""
    return smooth_max(a, -tool, radius)


def _scaled_norm_distance(
    scaled: Sequence[Values], radii: Sequence[np.ndarray | float] | np.ndarray
) -> Values:
    """First-order distance to an ellipsoid, from coordinates divided by its radii."""
    squared = sum(s * s for s in scaled)
    slope = sum((s / r) ** 2 for s, r in zip(scaled, radii, strict=True))
    k0 = np.sqrt(squared + 1e-12)
    depth = k0 / np.sqrt(slope + 1e-9)
    # First order is accurate at the surface only. Deep inside a thin solid it would follow the
    # long axes, so the length scale fades to the shortest radius towards the centre.
    shortest = radii[0]
    for r in radii[1:]:
        shortest = np.minimum(shortest, r)
    depth = shortest + (depth - shortest) * np.minimum(k0, 1.0) ** 4
    return (k0 - 1.0) * depth


def ellipsoid(p: Points, centre: Vector, radii: Vector, axes: np.ndarray | None = None) -> Values:
    """Ellipsoid; rows of `axes` are its directions (the world's by default)."""
    q = p - np.asarray(centre)
    if axes is not None:
        q = q @ axes.T
    return _scaled_norm_distance([q[:, i] / radii[i] for i in range(3)], radii)


def sphere(p: Points, centre: Vector, radius: float) -> Values:
    """Exact distance to a sphere."""
    return np.sqrt(((p - np.asarray(centre)) ** 2).sum(1)) - radius


def cone(p: Points, start: Vector, end: Vector, r_start: float, r_end: float) -> Values:
    """Capsule whose radius changes linearly from one end to the other."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    axis = end - start
    q = p - start
    t = np.clip(q @ axis / (axis @ axis), 0.0, 1.0)
    return np.sqrt(((q - t[:, None] * axis) ** 2).sum(1)) - (r_start + (r_end - r_start) * t)


class Sweep:
    """A solid swept along a straight axis with oval sections that vary smoothly.

    keys: rows (t, offset_u, offset_v, r_u, r_v_plus, r_v_minus), t in metres from `origin`.
    The two sides of the v direction have separate radii, for calves, buttocks and chest. The ends
    are closed by half ellipsoids of depth `caps`.
    `squareness` is the exponent of the section (2 is an ellipse).
    """

    def __init__(
        self,
        origin: Vector,
        axis: Vector,
        u: Vector,
        keys: Sequence[Vector] | np.ndarray,
        caps: tuple[float, float],
        squareness: float = 2.0,
    ):
        from scipy.interpolate import PchipInterpolator

        self.origin = np.asarray(origin, dtype=float)
        self.w = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
        u = np.asarray(u, dtype=float)
        u = u - self.w * (u @ self.w)
        self.u = u / np.linalg.norm(u)
        v = np.cross(self.w, self.u)
        # v always points to the front (or up, for axes along Z), whatever the handedness.
        lead = 2 if abs(v[2]) > 0.5 else 1
        self.v = v * np.sign(v[lead])
        table = np.asarray(keys, dtype=float)
        self.t0, self.t1 = table[0, 0], table[-1, 0]
        self.grid = np.linspace(self.t0, self.t1, 257)
        self.table = PchipInterpolator(table[:, 0], table[:, 1:])(self.grid)
        self.caps = caps
        self.power = squareness

    def __call__(self, p: Points) -> Values:
        q = p - self.origin
        t = q @ self.w
        s = (np.clip(t, self.t0, self.t1) - self.t0) * (256.0 / (self.t1 - self.t0))
        i = np.minimum(s.astype(np.int64), 255)
        row = self.table[i] + (s - i)[:, None] * (self.table[i + 1] - self.table[i])
        x = q @ self.u - row[:, 0]
        y = q @ self.v - row[:, 1]
        ru = row[:, 2]
        rv = np.where(y > 0.0, row[:, 3], row[:, 4])
        over = np.where(t > self.t1, (t - self.t1) / self.caps[1], 0.0)
        over = np.where(t < self.t0, (self.t0 - t) / self.caps[0], over)
        rw = np.where(t > self.t1, self.caps[1], self.caps[0])
        a, b = np.abs(x) / ru, np.abs(y) / rv
        if self.power == 2.0:
            return _scaled_norm_distance([a, b, over], [ru, rv, rw])
        n = self.power
        section = (a**n + b**n + 1e-12) ** (1.0 / n)
        # Gradient of the section's norm; the cap is joined as in an ellipsoid.
        slope2 = ((a / section) ** (n - 1) / ru) ** 2 + ((b / section) ** (n - 1) / rv) ** 2
        k0 = np.sqrt(section**2 + over**2 + 1e-12)
        slope = np.sqrt(((section / k0) ** 2) * slope2 + ((over / k0) / rw) ** 2 + 1e-9)
        return (k0 - 1.0) / slope


def gradient(field: Field, p: Points, step: np.ndarray) -> tuple[Values, Points]:
    """Value and gradient from four samples at the corners of a small tetrahedron."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    h = step[:, None] / np.sqrt(3.0)
    values = field((p[None] + corners[:, None] * h[None]).reshape(-1, 3)).reshape(4, -1)
    slope = np.einsum("kn,kd->nd", values, corners) / (4.0 * h)
    return values.mean(0), slope
