"""Scans as triangles in the frame of the posed root, and the body's own hands for theirs."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...avatar import body_only
from ...body import (
    BodyModel,
    BodyParams,
    bone_transforms,
    canonical_pose,
    pose_body,
    with_betas,
)
from ...fields import template_weights
from ...frames import Frames
from ...geometry import (
    closest_points,
    face_areas,
    face_normals,
    sample_surface,
    vertex_normals,
)
from ...kinematics import KinematicTree

_TURN_M = 0.05  # the distance that a difference of normals of one counts as
_WRISTS = ("left_wrist", "right_wrist")


class Scans(eqx.Module):
    """Triangles of F frames, T each, in the frame of the posed root, metres.

    - `corners`: `(F, T, 3, 3)`; `known`: `(F, T, 3, J)` the template's weights at the nearest point
      of the posed body.
    - `transforms`: `(F, J, 4, 4)` from canonical space; `params`: batched over F.
    """

    corners: Float[Array, "F T 3 3"]
    known: Float[Array, "F T 3 J"]
    transforms: Float[Array, "F J 4 4"]
    params: BodyParams


def read_scans(
    body: BodyModel, frames: Frames, betas: Any, *, triangles: int, seed: int, bar: Any
) -> Scans:
    """Draw `triangles` triangles of each frame by area, keyed by seed and place."""
    params = with_betas(frames.params, betas)
    all_corners, all_known, all_transforms = [], [], []
    for k in range(len(frames)):
        frame = frames[k]
        posed, transforms = (np.asarray(v, np.float64) for v in _posed(body, params[k]))
        upright = np.linalg.inv(transforms[0])
        rng = np.random.default_rng((seed, k))
        _, chosen = sample_surface(frame.vertices, frame.faces, triangles, rng)
        corners = np.asarray(frame.vertices, np.float64)[frame.faces[chosen]].reshape(-1, 3)
        normals = np.repeat(face_normals(frame.vertices, frame.faces[chosen]), 3, axis=0)
        known = nearest_weights(body, posed, corners, normals)
        corners = corners @ upright[:3, :3].T + upright[:3, 3]
        all_corners.append(corners.reshape(-1, 3, 3).astype(np.float32))
        all_known.append(known.reshape(len(chosen), 3, -1).astype(np.float32))
        all_transforms.append((upright @ transforms).astype(np.float32))
        bar.update(1)
    return Scans(
        corners=jnp.asarray(np.stack(all_corners)),
        known=jnp.asarray(np.stack(all_known)),
        transforms=jnp.asarray(np.stack(all_transforms)),
        params=jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params),
    )


def nearest_weights(
    body: BodyModel,
    posed: Float[np.ndarray, "V 3"],
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N J"]:
    """The template's weights at the nearest point of the posed body that faces the same way.

    Where parts touch, the nearest point is often the other part's, which faces the other way:
    there the nearest vertex counts, with the difference of normals as a distance of centimetres.
    """
    from scipy.spatial import cKDTree

    weights = template_weights(body, posed, points)
    _, face, _ = closest_points(posed, body.faces, points)
    away = np.flatnonzero((face_normals(posed, body.faces)[face] * normals).sum(1) < 0)
    if len(away):
        tree = cKDTree(np.concatenate([posed, _TURN_M * vertex_normals(posed, body.faces)], 1))
        _, vertex = tree.query(np.concatenate([points, _TURN_M * normals], 1)[away])
        weights[away] = np.asarray(body.weights, np.float64)[vertex]
    return weights


@eqx.filter_jit
def _posed(body: BodyModel, params: BodyParams) -> tuple[Array, Array]:
    return pose_body(body, params).vertices, bone_transforms(body, params)


def edge_stretch(
    before: Float[np.ndarray, "*n 3 3"], after: Float[np.ndarray, "*n 3 3"]
) -> Float[np.ndarray, "*n"]:
    """By how much the most changed edge of each triangle is longer or shorter: one or more."""
    first, second = (
        np.linalg.norm(t - np.roll(t, 1, axis=-2), axis=-1) + 1e-9 for t in (before, after)
    )
    ratio = second / first
    return np.maximum(ratio, 1 / ratio).max(-1)


def moves_with_wrist(
    tree: KinematicTree, weights: Float[np.ndarray, "*n 3 J"]
) -> Bool[np.ndarray, "*n"]:
    """Triangles that a wrist moves most, by the weights of their corners."""
    return weights[..., tree.indices(*_WRISTS)].sum(-1).mean(-1) > 0.5


def static_hands(
    whole: BodyModel, params: BodyParams, betas: Any
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, " n"]] | None:
    """Canonical triangles of the person's hands, and the area of each, as a share of all.

    Fingers have the mean pose of `params`, batched. None for a body without wrists.
    """
    cut = body_only(whole)
    faces = np.asarray(whole.faces)
    on_hand = moves_with_wrist(cut.tree, np.asarray(cut.weights)[faces])
    if not on_hand.any():
        return None
    pose = np.array(canonical_pose(whole))
    for wrist in whole.tree.indices(*_WRISTS):
        fingers = [j for j in whole.tree.subtree(wrist) if j != wrist]
        pose[fingers] = np.asarray(params.pose).mean(0)[fingers]
    own = BodyParams.create(whole, pose=pose, betas=betas)
    vertices = np.asarray(pose_body(whole, own).vertices, np.float64)
    area = face_areas(vertices, faces[on_hand])
    return vertices[faces[on_hand]], area / area.sum()
