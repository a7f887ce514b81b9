"""SCANimate's three stages: what a step draws, what it computes, and its loss terms."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ...body import BodyParams
from ...fields import AbstractGeometryField, AbstractSkinningField, learned_leaves
from ...kinematics import skin_points, unskin_points
from ...learning import FALLING, STEPWISE, Stage, Terms
from .config import ShapeWeights, SkinWeights, StagePlan
from .networks import InverseSkinning

_JITTER_M = 0.05  # of the points off the surface at which the gradient has length one
_MARGIN_M = 0.2  # between the body and its box
_DRAWS = 1024  # points in the box, and on its faces
_LEAST = 1e-6  # a power below one has no derivative at zero
_RISING = optax.piecewise_constant_schedule(1.0, {0.5: 10.0, 0.75: 10.0})  # pyright: ignore[reportArgumentType]


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


class Draw(eqx.Module):
    """Random frames `(B,)`, and random triangles `(B, M)` of each."""

    frames: int = eqx.field(static=True)
    triangles: int = eqx.field(static=True)

    def __call__(
        self, model: Any, data: tuple[Any, Template], key: PRNGKeyArray
    ) -> tuple[Any, Template, Int[Array, " B"], Int[Array, "B M"]]:
        scans, template = data
        count, size = scans.corners.shape[:2]
        frame_key, row_key = jax.random.split(key)
        chosen = jax.random.randint(frame_key, (self.frames,), 0, count)
        rows = jax.random.randint(row_key, (self.frames, self.triangles), 0, size)
        return scans, template, chosen, rows


def canonicalise(
    nets: SkinNets,
    latent: Float[Array, " k"],
    corners: Float[Array, "n 3"],
    known: Float[Array, "n J"],
    transforms: Float[Array, "J 4 4"],
) -> tuple[Float[Array, "n 3"], Float[Array, "n J"]]:
    """One frame's points in canonical space by the inverse net, and its weights there."""
    weights = jax.vmap(nets.inverse, in_axes=(0, None, 0))(corners, latent, known)
    return unskin_points(corners, weights, transforms), weights


class Skinned(NamedTuple):
    """What the nets answered at the template's vertices (M) and at corners of triangles (n)."""

    wanted: Float[Array, "M J"]
    forward_at_body: Float[Array, "M J"]
    inverse_at_body: Float[Array, "B M J"]
    known: Float[Array, "B n J"]
    inverse: Float[Array, "B n J"]
    forward: Float[Array, "B n J"]
    latent: Float[Array, "B k"]
    corners: Float[Array, "B n 3"]
    again: Float[Array, "B n 3"]


class SkinForward(eqx.Module):
    """Stages 1 and 2: both nets at the template and at scans. In stage 2 (`cycle`) the forward net
    reads the points that the inverse net has canonicalised."""

    points: int = eqx.field(static=True)
    cycle: bool = eqx.field(static=True)

    def __call__(self, nets: SkinNets, batch: Any, key: PRNGKeyArray) -> Skinned:
        scans, template, chosen, triangles = batch
        rows = jax.random.randint(key, (self.points,), 0, len(template.vertices))
        vertices, wanted = template.vertices[rows], template.weights[rows]

        def one_frame(frame: Array, rows: Array) -> tuple[Array, ...]:
            latent, transforms = nets.inverse.latents[frame], scans.transforms[frame]
            corners = scans.corners[frame, rows].reshape(-1, 3)
            known = scans.known[frame, rows].reshape(len(corners), -1)
            at_body = jax.vmap(nets.inverse, in_axes=(0, None, 0))(
                skin_points(vertices, wanted, transforms), latent, wanted
            )
            canonical, inverse = canonicalise(nets, latent, corners, known, transforms)
            start = canonical if self.cycle else unskin_points(corners, known, transforms)
            forward = jax.vmap(nets.forward)(start)
            again = skin_points(canonical, forward, transforms)
            return at_body, known, inverse, forward, latent, corners, again

        outputs = jax.vmap(one_frame)(chosen, triangles)
        return Skinned(wanted, jax.vmap(nets.forward)(vertices), *outputs)


def _error(weights: Float[Array, "*n J"], wanted: Float[Array, "*n J"]) -> Float[Array, ""]:
    """Mean squared difference of skinning weights."""
    return ((weights - wanted) ** 2).mean()


def body_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Template weights at the body's vertices, for both nets."""
    wanted = jnp.broadcast_to(out.wanted, out.inverse_at_body.shape)
    return _error(out.inverse_at_body, wanted) + _error(out.forward_at_body, out.wanted)


def scan_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Known weights at scans, for the forward net."""
    return _error(out.forward, out.known)


def both_scan_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Known weights at scans, for both nets."""
    return _error(out.forward, out.known) + _error(out.inverse, out.known)


def sparsity_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Mean over points of $\\sum_j |w_j|^{0.8}$: least where one bone has all weight."""
    return (jnp.maximum(jnp.abs(out.inverse), _LEAST) ** 0.8).sum(-1).mean()


def latent_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Mean length of the latent vectors."""
    return jnp.sqrt((out.latent**2).sum(-1) + _LEAST**2).mean()


def cycle_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Mean absolute difference of coordinates between a point and its image there and back."""
    return jnp.abs(out.corners - out.again).mean()


def agreement_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Both nets give the same weights."""
    return _error(out.inverse, out.forward)


def edge_term(nets: SkinNets, out: Skinned, key: Any) -> Float[Array, ""]:
    """Mean over the edges of triangles of $\\sum_j |w_j(a) - w_j(b)|$."""
    weights = out.inverse.reshape(-1, 3, out.inverse.shape[-1])
    return jnp.abs(weights - jnp.roll(weights, 1, axis=-2)).sum(-1).mean()


class _LearnsNets(eqx.Module):
    forward: bool = eqx.field(static=True)

    def __call__(self, nets: SkinNets) -> SkinNets:
        own = learned_leaves(nets)
        if self.forward:
            return own
        return SkinNets(jax.tree.map(lambda _: False, nets.forward), own.inverse)


@lru_cache
def _optimiser(rate: float, clip: float, epsilon: float) -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(clip), optax.adam(rate, eps=epsilon))


def skin_stage(
    plan: StagePlan,
    weights: SkinWeights,
    *,
    cycle: bool,
    learn_forward: bool,
    clip: float,
    epsilon: float,
) -> Stage:
    """Stage 1, or with `cycle` stage 2, in which the weight of the cycle term rises."""
    terms: Terms = {
        "body": (weights.body, body_term),
        "scan": (weights.scan, both_scan_term if cycle else scan_term),
        "sparsity": (weights.sparsity, sparsity_term),
        "latent": (weights.latent, latent_term),
    }
    if cycle:
        terms |= {
            "cycle": (_rising(weights.cycle), cycle_term),
            "agreement": (weights.agreement, agreement_term),
            "edge": (weights.edge, edge_term),
        }
    name = "cycle" if cycle else "skin"
    return Stage(
        name, Draw(plan.frames, plan.points), terms, _optimiser(plan.rate, clip, epsilon),
        _LearnsNets(learn_forward), _schedule(plan), prefix=f"{name}_",
        forward=SkinForward(plan.points, cycle),
    )  # fmt: skip


@lru_cache
def _rising(weight: float) -> optax.Schedule:
    return lambda done: weight * _RISING(done)


def _schedule(plan: StagePlan) -> optax.Schedule:
    return {"cosine": FALLING, "steps": STEPWISE}[plan.schedule]


class Shaped(NamedTuple):
    """Distances, positive outside, and their gradients, where the shape stage looks at them."""

    inside: Float[Array, " n"]
    faces: Float[Array, " n"]
    value: Float[Array, "B M"]
    beside: Float[Array, "B M"] | None
    step: Float[Array, "B M"] | None
    slope: Float[Array, "B M 3"] | None
    slopes: Float[Array, "n 3"] | None
    normals: Float[Array, "B M 3"]


class ShapeForward(eqx.Module):
    """Stage 3: the distance at canonical triangles, near them, and in the box.

    A geometry's level is the distance, positive inside, over `softness`.
    """

    softness: float = eqx.field(static=True)
    sigma: tuple[float, ...] = eqx.field(static=True)
    gradients: bool = eqx.field(static=True)
    offsets: bool = eqx.field(static=True)

    def __call__(self, geometry: AbstractGeometryField, batch: Any, key: PRNGKeyArray) -> Shaped:
        scans, template, chosen, rows = batch
        place_key, off_key, box_key = jax.random.split(key, 3)
        points, normals = _on_triangles(scans.corners[chosen[:, None], rows], place_key)
        params = jax.tree.map(lambda v: v[chosen], scans.params)
        conditions = jax.vmap(geometry.condition)(params)
        first = jax.tree.map(lambda leaf: leaf[0], conditions)

        def distance(x: Array, condition: Any) -> Array:
            return -self.softness * geometry(x, condition).level

        def everywhere(function: Any, where: Array) -> Any:
            return jax.vmap(jax.vmap(function, in_axes=(0, None)))(where, conditions)

        inside, faces = _box_points(template.vertices, box_key)
        beside = step = slope = slopes = None
        if self.gradients:
            value, slope = everywhere(jax.value_and_grad(distance), points)
            around = everywhere(
                jax.grad(distance), _off_surface(points, template.vertices, off_key)
            )
            in_box = jax.vmap(lambda x: jax.grad(distance)(x, first))(inside)
            slopes = jnp.concatenate([v.reshape(-1, 3) for v in (slope, around, in_box)])
        else:
            value = everywhere(distance, points)
        if self.offsets:
            sigma = jnp.asarray(np.resize(np.asarray(self.sigma), points.shape[1]), points.dtype)
            step = sigma * jax.random.normal(off_key, points.shape[:2])
            beside = everywhere(distance, points + step[..., None] * normals)
        at = jax.vmap(lambda x: distance(x, first))
        return Shaped(at(inside), at(faces), value, beside, step, slope, slopes, normals)


def surface_term(geometry: Any, out: Shaped, key: Any) -> Float[Array, ""]:
    """The distance is zero on the scans."""
    return jnp.abs(out.value).mean()


def empty_term(geometry: Any, out: Shaped, key: Any) -> Float[Array, ""]:
    """Mean of $e^{-100 |d|}$ in the box: how much surface is where none should be."""
    return jnp.exp(-100 * jnp.abs(out.inside)).mean()


def faces_term(geometry: Any, out: Shaped, key: Any) -> Float[Array, ""]:
    """Mean depth of the box's faces, which should be outside."""
    return jnp.maximum(-out.faces, 0).mean()


def normal_term(geometry: Any, out: Shaped, key: Any) -> Float[Array, ""]:
    """Mean length of the difference between the gradient and the outward normal."""
    assert out.slope is not None
    return jnp.sqrt(((out.slope - out.normals) ** 2).sum(-1) + _LEAST**2).mean()


def eikonal_term(geometry: Any, out: Shaped, key: Any) -> Float[Array, ""]:
    """Mean of $(|g| - 1)^2$ (Gropp et al., 2020)."""
    assert out.slopes is not None
    return ((jnp.sqrt((out.slopes**2).sum(-1) + _LEAST**2) - 1) ** 2).mean()


def offset_term(geometry: Any, out: Shaped, key: Any) -> Float[Array, ""]:
    """The distance at a step along the normal is that step."""
    assert out.beside is not None
    return jnp.abs(out.beside - out.step).mean()  # pyright: ignore[reportOperatorIssue]


_SHAPE_TERMS = {
    "surface": surface_term, "normal": normal_term, "eikonal": eikonal_term,
    "offset": offset_term, "empty": empty_term, "faces": faces_term,
}  # fmt: skip


def shape_stage(
    plan: StagePlan, weights: ShapeWeights, *, softness: float, clip: float, epsilon: float
) -> Stage:
    """Stage 3. A term of weight 0 is not computed."""
    gradients = bool(weights.normal or weights.eikonal)
    forward = ShapeForward(softness, tuple(weights.sigma), gradients, bool(weights.offset))
    terms = {
        name: (getattr(weights, name), term)
        for name, term in _SHAPE_TERMS.items()
        if getattr(weights, name)
    }
    return Stage(
        "shape", Draw(plan.frames, plan.points), terms, _optimiser(plan.rate, clip, epsilon),
        learned_leaves, _schedule(plan), prefix="shape_", forward=forward,
    )  # fmt: skip


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
