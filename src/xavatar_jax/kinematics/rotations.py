"""Axis-angle vectors and rotation matrices, with correct derivatives at zero rotation."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

TO_Y_UP = {"y": np.eye(3), "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])}
"""Rotation about x that turns the given up axis ("y" in the SMPL family, "z" in AMASS) to y."""


def axis_angle_to_matrix(rotation: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix of axis times angle (radians), by Rodrigues' formula."""
    x, y, z = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    angle_sq = x * x + y * y + z * z
    small = angle_sq < 1e-4
    # A dummy input for the branch not taken, since reverse mode differentiates both.
    safe_sq = jnp.where(small, 1.0, angle_sq)
    angle = jnp.sqrt(safe_sq)
    sinc = jnp.where(
        small, 1 - angle_sq / 6 + angle_sq**2 / 120 - angle_sq**3 / 5040, jnp.sin(angle) / angle
    )
    # 1 - cos as twice a squared sine avoids cancellation at small angles.
    cosc = jnp.where(
        small,
        0.5 - angle_sq / 24 + angle_sq**2 / 720 - angle_sq**3 / 40320,
        2 * jnp.sin(angle / 2) ** 2 / safe_sq,
    )
    rows = (
        (1 - cosc * (y * y + z * z), cosc * x * y - sinc * z, cosc * x * z + sinc * y),
        (cosc * x * y + sinc * z, 1 - cosc * (x * x + z * z), cosc * y * z - sinc * x),
        (cosc * x * z - sinc * y, cosc * y * z + sinc * x, 1 - cosc * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_axis_angle(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """The inverse of `axis_angle_to_matrix`, with angles in [0, pi].

    Uses the quaternion divided by its largest component, which is accurate at every angle
    including pi (Shepperd, 1978).
    """
    m = matrix
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    # Rows: 4 q_k q for k = w, x, y, z. The largest squared component picks the row.
    candidates = jnp.stack(
        [
            jnp.stack([1 + m00 + m11 + m22, a, b, c], axis=-1),
            jnp.stack([a, 1 + m00 - m11 - m22, d, e], axis=-1),
            jnp.stack([b, d, 1 - m00 + m11 - m22, f], axis=-1),
            jnp.stack([c, e, f, 1 - m00 - m11 + m22], axis=-1),
        ],
        axis=-2,
    )
    largest = jnp.argmax(jnp.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    quaternion = jnp.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    quaternion = jnp.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    w, xyz = quaternion[..., 0], quaternion[..., 1:]
    sine_sq = jnp.sum(xyz * xyz, axis=-1)
    small = sine_sq < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1.0, sine_sq))
    factor = jnp.where(small, 2 + sine_sq / 3, 2 * jnp.arctan2(sine, w) / sine)
    return factor[..., None] * xyz
