"""Search problems with known answers, shared by the benchmarks: fields, poses, points, recall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import xavatar_jax as xa
from xavatar_jax.body import BODY, FACES, HANDS, LEFT_HAND, RIGHT_HAND, BodyModel
from xavatar_jax.fields import AbstractSkinningField
from xavatar_jax.kinematics import skin_points
from xavatar_jax.training import FitConfig, paper
from xavatar_jax.training.prefit import initial_fields

# A root this close to the canonical point that made the posed one counts as that point found.
SAME_POINT_M = 1e-3
# Canonical points lie about this far from the surface: a normal deviate an axis.
NOISE_M = 0.005
SHARES = (((BODY,), 3 / 6), (FACES, 1 / 6), ((LEFT_HAND,), 1 / 6), ((RIGHT_HAND,), 1 / 6))
QUICK_PREFIT, FULL_PREFIT = 1000, 4000


class Problem(NamedTuple):
    """One frame: canonical points, their parts, where the field itself carries them, transforms."""

    x_c: Float[Array, "P 3"]
    parts: Int[Array, " P"]
    x_d: Float[Array, "P 3"]
    transforms: Float[Array, "J 4 4"]


def paper_config(seed: int, prefit_steps: int) -> FitConfig:
    """The paper's skinning network and losses; a geometry field that two cores can fit."""
    config = paper()
    return replace(
        config,
        seed=seed,
        prefit_steps=prefit_steps,
        geometry=replace(xa.quick().geometry),
        losses=replace(config.losses, softness=0.004, surface_points=512),
        optimiser=replace(config.optimiser, learning_rate=3e-3, skinning_rate=1e-4, clip=1.0),
    )


def paper_field(
    body: BodyModel, prefit_steps: int, seed: int = 0, cache: str | None = None
) -> AbstractSkinningField:
    """The paper's network (5 x 128), fitted to the template's weights around the mean shape."""
    return initial_fields(body, paper_config(seed, prefit_steps), cache=cache).skinning


def hard_pose(
    body: BodyModel, rng: np.random.Generator, degrees: float
) -> Float[np.ndarray, "J 3"]:
    """Every joint turned by normal deviates of `degrees` an axis; spine and pelvis 0.3 of that."""
    stiff = np.array([n == "pelvis" or n.startswith("spine") for n in body.tree.names])
    scale = np.radians(degrees) * np.where(stiff, 0.3, 1.0)
    return scale[:, None] * rng.standard_normal((body.num_joints, 3))


def near_surface(
    vertices: Float[np.ndarray, "V 3"],
    labels: Int[np.ndarray, " V"],
    count: int,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, " P"]]:
    """Canonical points around vertices, half of them of the body, and their parts."""
    each = [int(count * share) for _, share in SHARES]
    each[0] += count - sum(each)  # what rounding left
    rows = np.concatenate(
        [
            rng.choice(np.flatnonzero(np.isin(labels, parts)), own)
            for (parts, _), own in zip(SHARES, each, strict=True)
        ]
    )
    points = vertices[rows] + NOISE_M * rng.standard_normal((len(rows), 3))
    return points.astype(np.float32), labels[rows].astype(np.int32)


@eqx.filter_jit
def carry(
    field: AbstractSkinningField, x_c: Float[Array, "P 3"], transforms: Float[Array, "J 4 4"]
) -> Float[Array, "P 3"]:
    """Canonical points to posed ones, in chunks."""
    skin = lambda x: skin_points(x, field(x), transforms)  # noqa: E731
    return jax.lax.map(skin, x_c, batch_size=8192)


def known_points(
    body: BodyModel,
    field: AbstractSkinningField,
    vertices: Float[np.ndarray, "V 3"],
    frames: Sequence[Any],
    count: int,
    seed: int,
) -> list[Problem]:
    """Points near the canonical surface and where the field carries them in each frame.

    `frames` are `BodyParams`.
    """
    rng = np.random.default_rng(seed)
    labels = np.asarray(body.part_labels)
    problems = []
    for params in frames:
        x_c, parts = near_surface(vertices, labels, count, rng)
        transforms = jnp.asarray(xa.bone_transforms(body, params), jnp.float32)
        x_d = carry(field, jnp.asarray(x_c), transforms)
        problems.append(Problem(jnp.asarray(x_c), jnp.asarray(parts), x_d, transforms))
    return problems


def hard_problems(
    body: BodyModel,
    field: AbstractSkinningField,
    vertices: Float[np.ndarray, "V 3"],
    *,
    degrees: float,
    frames: int,
    count: int,
    seed: int,
) -> list[Problem]:
    """`known_points` of random poses: 3/6 body, 1/6 face, 1/6 each hand."""
    rng = np.random.default_rng([seed, 1])
    poses = [xa.BodyParams.create(body, pose=hard_pose(body, rng, degrees)) for _ in range(frames)]
    return known_points(body, field, vertices, poses, count, seed)


def hits(
    x_c: Float[np.ndarray, "P K 3"],
    valid: Bool[np.ndarray, "P K"],
    truth: Float[np.ndarray, "P 3"],
    within_m: float = SAME_POINT_M,
) -> Bool[np.ndarray, " P"]:
    """Points for which one of the roots is the canonical point that made them."""
    gap = np.linalg.norm(np.asarray(x_c) - np.asarray(truth)[:, None], axis=-1)
    return np.where(np.asarray(valid), gap, np.inf).min(1) < within_m


def recall(hit: Bool[np.ndarray, " P"], parts: Int[np.ndarray, " P"]) -> dict[str, float]:
    """Share of known correspondences found, of all points and by region."""
    regions = {"all": None, "body": (BODY,), "face": FACES, "hands": HANDS}
    return {
        f"recall_{name}": float(hit[slice(None) if own is None else np.isin(parts, own)].mean())
        for name, own in regions.items()
    }
