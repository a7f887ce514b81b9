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
from xavatar_jax.body import BodyModel, Parts
from xavatar_jax.fields import AbstractSkinningField, AvatarModel, build_model
from xavatar_jax.frames import Frames
from xavatar_jax.kinematics import skin_points
from xavatar_jax.learning import Stage
from xavatar_jax.methods.xavatar import FitConfig, paper
from xavatar_jax.methods.xavatar.roots import FrameData, frame_data
from xavatar_jax.methods.xavatar.stages import training_stages
from xavatar_jax.methods.xavatar.start import fit_mean_shape
from xavatar_jax.sampling import volume_points

# A known correspondence counts as found if a root is this close to it.
SAME_POINT_M = 1e-3
# Standard deviation per axis of canonical points around the surface.
NOISE_M = 0.005
PARTS = Parts(np.zeros(0, np.int8))  # those of the SMPL family
SHARES = tuple(
    (PARTS.members(name), share / 6)
    for name, share in (("body", 3), ("face", 1), ("left_hand", 1), ("right_hand", 1))
)
QUICK_PREFIT, FULL_PREFIT = 150, 4000


class Problem(NamedTuple):
    """One frame: canonical points, their parts, their posed positions, and bone transforms."""

    x_c: Float[Array, "P 3"]
    parts: Int[Array, " P"]
    x_d: Float[Array, "P 3"]
    transforms: Float[Array, "J 4 4"]


def paper_config(seed: int, prefit_steps: int) -> FitConfig:
    """The paper's skinning network and losses, with a geometry field that two cores can fit."""
    config = paper()
    return replace(
        config,
        seed=seed,
        prefit_steps=prefit_steps,
        geometry=replace(xa.quick().geometry),
        losses=replace(config.losses, softness=0.004, surface_points=512),
        optimiser=replace(config.optimiser, learning_rate=3e-3, skinning_rate=1e-4, clip=1.0),
    )


def mean_shape_model(
    body: BodyModel, config: FitConfig, *, cache: str | None = None
) -> AvatarModel:
    """The config's model, fitted to the body's mean shape or read from the cache folder."""
    model = build_model(config.spec, body, key=jax.random.key(config.seed))
    return fit_mean_shape(
        model, config.spec, body, steps=config.prefit_steps, optimiser=config.optimiser,
        seed=config.seed, cache=cache,
    )  # fmt: skip


def paper_field(
    body: BodyModel, prefit_steps: int, seed: int = 0, cache: str | None = None
) -> AbstractSkinningField:
    """The paper's network (5 x 128), fitted to the template's weights around the mean shape."""
    return mean_shape_model(body, paper_config(seed, prefit_steps), cache=cache).skinning


def labelled_frames(body: BodyModel, frames: Frames, config: FitConfig) -> FrameData:
    """Labelled points of frames, without their translation and without roots."""
    drawn = []
    for k, frame in enumerate(frames):
        rng = np.random.default_rng((config.seed, k))
        points = volume_points(frame, body.parts, config.points, rng)
        drawn.append(points._replace(x_d=points.x_d - np.asarray(frame.params.transl, np.float32)))
    samples = jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)
    return frame_data(body, samples, frames.params)


def stages_of(body: BodyModel, betas: Any, data: FrameData, config: FitConfig) -> tuple[Stage, ...]:
    """The training stages of a config, without validation frames."""
    return training_stages(
        body, betas, data,
        search=config.search, losses=config.losses, optimiser=config.optimiser,
        frames=config.frames_per_step, points=config.points_per_step,
        skinning_points=config.skinning_points, skinning_every=config.skinning_every,
        learn_skinning=config.learn_skinning,
    )  # fmt: skip


def hard_pose(
    body: BodyModel, rng: np.random.Generator, degrees: float
) -> Float[np.ndarray, "J 3"]:
    """Normally distributed joint rotations, `degrees` per axis; 0.3 of it for spine and pelvis."""
    stiff = np.array([n == "pelvis" or n.startswith("spine") for n in body.tree.names])
    scale = np.radians(degrees) * np.where(stiff, 0.3, 1.0)
    return scale[:, None] * rng.standard_normal((body.num_joints, 3))


def near_surface(
    vertices: Float[np.ndarray, "V 3"],
    labels: Int[np.ndarray, " V"],
    count: int,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, " P"]]:
    """Canonical points around vertices, in the `SHARES` of the parts, and their parts."""
    each = [int(count * share) for _, share in SHARES]
    each[0] += count - sum(each)  # remainder of rounding
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
    """Map canonical points to posed points, in chunks."""
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
    """Points near the canonical surface and their posed positions in each frame.

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
    """`known_points` for random poses."""
    rng = np.random.default_rng([seed, 1])
    poses = [xa.BodyParams.create(body, pose=hard_pose(body, rng, degrees)) for _ in range(frames)]
    return known_points(body, field, vertices, poses, count, seed)


def hits(
    x_c: Float[np.ndarray, "P K 3"],
    valid: Bool[np.ndarray, "P K"],
    truth: Float[np.ndarray, "P 3"],
    within_m: float = SAME_POINT_M,
) -> Bool[np.ndarray, " P"]:
    """Mask of points with a root within `within_m` of their true canonical point."""
    gap = np.linalg.norm(np.asarray(x_c) - np.asarray(truth)[:, None], axis=-1)
    return np.where(np.asarray(valid), gap, np.inf).min(1) < within_m


def recall(hit: Bool[np.ndarray, " P"], parts: Int[np.ndarray, " P"]) -> dict[str, float]:
    """Share of known correspondences that were found, for all points and by region."""
    regions = {"all": None, **{name: PARTS.members(name) for name in ("body", "face", "hands")}}
    return {
        f"recall_{name}": float(hit[slice(None) if own is None else np.isin(parts, own)].mean())
        for name, own in regions.items()
    }
