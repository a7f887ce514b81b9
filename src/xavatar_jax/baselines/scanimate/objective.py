"""The losses of SCANimate's three stages, on a batch of triangles."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ...body import BodyParams
from ...fields import AbstractGeometryField, AbstractSkinningField
from ...kinematics import skin_points, unskin_points
from .config import ScanimateConfig, Stage
from .fields import InverseSkinning
from .losses import (
    cycle_error,
    edge_difference,
    eikonal_error,
    latent_size,
    nearness,
    normal_error,
    sparsity,
    weight_error,
    wrong_side,
)
from .scans import Scans

Terms = dict[str, Float[Array, ""]]
_JITTER_M = 0.05  # of points off the surface, whose gradient has length one
_MARGIN_M = 0.2  # between body and box
_DRAWS = 1024  # points in the box, and on its faces


class SkinNets(eqx.Module):
    """Forward and inverse skinning."""

    forward: AbstractSkinningField
    inverse: InverseSkinning


class Template(eqx.Module):
    """The person's canonical body: vertices `(V, 3)` and their weights `(V, J)`."""

    vertices: Float[Array, "V 3"]
    weights: Float[Array, "V J"]


class CanonicalScans(eqx.Module):
    """Triangles in canonical space `(F, T, 3, 3)`; parameters batched over F."""

    corners: Float[Array, "F T 3 3"]
    params: BodyParams


def canonicalise(
    nets: SkinNets,
    latent: Float[Array, " k"],
    corners: Float[Array, "n 3"],
    known: Float[Array, "n J"],
    transforms: Float[Array, "J 4 4"],
) -> tuple[Float[Array, "n 3"], Float[Array, "n J"]]:
    """Canonical places of one frame's points by the inverse net, and its weights there."""
    weights = jax.vmap(nets.inverse, in_axes=(0, None, 0))(corners, latent, known)
    return unskin_points(corners, weights, transforms), weights


def skin_objective(
    nets: SkinNets,
    scans: Scans,
    template: Template,
    config: ScanimateConfig,
    progress: Float[Array, ""],
    key: PRNGKeyArray,
    *,
    cycle: bool,
) -> tuple[Float[Array, ""], Terms]:
    """Stage 1, or with `cycle` stage 2, of which `progress` is done (0 to 1)."""
    stage = config.cycle if cycle else config.skin
    body_key, *keys = jax.random.split(key, 3)
    chosen, triangles = _draw(scans.corners.shape[:2], stage, *keys)
    body_rows = jax.random.randint(body_key, (stage.points,), 0, len(template.vertices))
    vertices, wanted = template.vertices[body_rows], template.weights[body_rows]

    def one_frame(frame: Array, rows: Array) -> Terms:
        latent, transforms = nets.inverse.latents[frame], scans.transforms[frame]
        corners = scans.corners[frame, rows].reshape(-1, 3)
        known = scans.known[frame, rows].reshape(len(corners), -1)
        at_body = jax.vmap(nets.inverse, in_axes=(0, None, 0))(
            skin_points(vertices, wanted, transforms), latent, wanted
        )
        canonical, inverse = canonicalise(nets, latent, corners, known, transforms)
        start = canonical if cycle else unskin_points(corners, known, transforms)
        forward = jax.vmap(nets.forward)(start)
        terms = {
            "body": weight_error(at_body, wanted),
            "scan": weight_error(forward, known),
            "sparsity": sparsity(inverse),
            "latent": latent_size(latent),
        }
        if cycle:
            again = skin_points(canonical, forward, transforms)
            terms |= {
                "scan": terms["scan"] + weight_error(inverse, known),
                "cycle": cycle_error(corners, again),
                "agreement": weight_error(inverse, forward),
                "edge": edge_difference(inverse.reshape(-1, 3, inverse.shape[-1])),
            }
        return terms

    terms = {name: value.mean() for name, value in jax.vmap(one_frame)(chosen, triangles).items()}
    terms["body"] += weight_error(jax.vmap(nets.forward)(vertices), wanted)
    weights = vars(config.skin_weights)
    raised = 10.0 ** ((progress >= 0.5).astype(float) + (progress >= 0.75))
    total = sum(
        weights[name] * value * (raised if name == "cycle" else 1.0)
        for name, value in terms.items()
    )
    return jnp.asarray(total), terms


def shape_objective(
    geometry: AbstractGeometryField,
    scans: CanonicalScans,
    template: Template,
    config: ScanimateConfig,
    key: PRNGKeyArray,
) -> tuple[Float[Array, ""], Terms]:
    """Stage 3: the distance, positive outside, at canonical triangles, near them, in the box."""
    weights, softness = config.shape_weights, config.start.losses.softness
    draw_key, place_key, off_key, box_key = jax.random.split(key, 4)
    chosen, rows = _draw(scans.corners.shape[:2], config.shape, *jax.random.split(draw_key))
    points, normals = _on_triangles(scans.corners[chosen[:, None], rows], place_key)
    conditions = jax.vmap(geometry.condition)(jax.tree.map(lambda v: v[chosen], scans.params))

    def distance(x: Array, condition: Any) -> Array:
        return -softness * geometry(x, condition)

    def everywhere(function: Any, where: Array) -> Any:
        return jax.vmap(jax.vmap(function, in_axes=(0, None)))(where, conditions)

    first = jax.tree.map(lambda leaf: leaf[0], conditions)
    inside, faces = _box_points(template.vertices, box_key)
    terms: Terms = {
        "empty": nearness(jax.vmap(lambda x: distance(x, first))(inside)),
        "faces": wrong_side(jax.vmap(lambda x: distance(x, first))(faces)),
    }
    if weights.normal or weights.eikonal:
        value, slope = everywhere(jax.value_and_grad(distance), points)
        around = everywhere(jax.grad(distance), _off_surface(points, template.vertices, off_key))
        in_box = jax.vmap(lambda x: jax.grad(distance)(x, first))(inside)
        terms["normal"] = normal_error(slope, normals)
        slopes = (slope, around, in_box)
        terms["eikonal"] = eikonal_error(jnp.concatenate([v.reshape(-1, 3) for v in slopes]))
    else:
        value = everywhere(distance, points)
    terms["surface"] = jnp.abs(value).mean()
    if weights.offset:
        sigma = jnp.asarray(np.resize(np.asarray(weights.sigma), points.shape[1]), points.dtype)
        step = sigma * jax.random.normal(off_key, points.shape[:2])
        beside = everywhere(distance, points + step[..., None] * normals)
        terms["offset"] = jnp.abs(beside - step).mean()
    by_name = vars(weights)
    return jnp.asarray(sum(by_name[name] * value for name, value in terms.items())), terms


def _draw(
    shape: tuple[int, ...], stage: Stage, frame_key: PRNGKeyArray, row_key: PRNGKeyArray
) -> tuple[Int[Array, " B"], Int[Array, "B M"]]:
    """Random frames, and random triangles of each."""
    chosen = jax.random.randint(frame_key, (stage.frames,), 0, shape[0])
    return chosen, jax.random.randint(row_key, (stage.frames, stage.points), 0, shape[1])


def _on_triangles(
    corners: Float[Array, "*n 3 3"], key: PRNGKeyArray
) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 3"]]:
    """A random point on each triangle, and the outward unit normal."""
    share = jax.random.dirichlet(key, jnp.ones(3), corners.shape[:-2])
    along = jnp.cross(
        corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    )
    length = jnp.sqrt((along**2).sum(-1, keepdims=True) + 1e-20)
    return (share[..., None] * corners).sum(-2), along / length


def _off_surface(
    points: Float[Array, "B M 3"], vertices: Float[Array, "V 3"], key: PRNGKeyArray
) -> Float[Array, "B M 3"]:
    """As many points some centimetres away, half from the points and half from the body."""
    row_key, noise_key = jax.random.split(key)
    half = points.shape[1] // 2
    rows = jax.random.randint(row_key, (points.shape[0], half), 0, len(vertices))
    near = jnp.concatenate([points[:, half:], vertices[rows]], axis=1)
    return near + _JITTER_M * jax.random.normal(noise_key, near.shape)


def _box_points(
    vertices: Float[Array, "V 3"], key: PRNGKeyArray
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Points in the box around the body, and on its faces."""
    low, high = vertices.min(0) - _MARGIN_M, vertices.max(0) + _MARGIN_M
    inside_key, face_key, side_key = jax.random.split(key, 3)
    inside = jax.random.uniform(inside_key, (_DRAWS, 3), minval=low, maxval=high)
    faces = jax.random.uniform(face_key, (_DRAWS, 3), minval=low, maxval=high)
    side = jax.random.bernoulli(side_key, 0.5, (_DRAWS, 1))
    flat = (jnp.arange(_DRAWS) % 3)[:, None] == jnp.arange(3)
    return inside, jnp.where(flat, jnp.where(side, low, high), faces)
