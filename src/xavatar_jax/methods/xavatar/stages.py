"""X-Avatar's training stages: what a step draws, its loss terms, and the validation loss."""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ...body import BodyModel, BodyParams, canonical_joints, canonical_vertices
from ...correspondence import (
    Broyden,
    StartTable,
    best_root,
    implicit_root,
    search_field,
    start_table,
)
from ...fields import (
    AbstractLink,
    AbstractSkinningField,
    AvatarModel,
    TabulatedSkinning,
    learned_leaves,
    pose_grid,
)
from ...kinematics import KinematicTree
from ...learning import BY_FRAME, BY_POINT, CONSTANT, FALLING, ONE_DEVICE, Devices, Stage, Terms
from ...sampling import bone_points, joint_targets
from .config import LossConfig, OptimiserConfig, SearchConfig
from .roots import FrameData

OWN_TERMS = ("loss", "gradient", "occupancy", "bone", "joint", "surface", "found", "validation")
"""Names of the terms and of the log, which user-defined terms cannot take."""


class PointBatch(NamedTuple):
    """Points of B frames, M each, with the root that was chosen for each point.

    - `x_d`: posed, `x_c`: canonical, metres; `part`: labels; `distance`: metres, positive inside.
    - `found`: whether the point has a root; without one, `x_c` is meaningless but finite.
    - `transforms`, `params`: of the frames.
    """

    x_d: Float[Array, "B M 3"]
    x_c: Float[Array, "B M 3"]
    part: Int[Array, "B M"]
    distance: Float[Array, "B M"]
    found: Bool[Array, "B M"]
    transforms: Float[Array, "B J 4 4"]
    params: BodyParams


_POINT_LEAVES = ("x_d", "x_c", "part", "distance", "found")


def _specs(batch: PointBatch) -> PointBatch:
    """How the leaves of a batch are divided among devices."""
    by_frame = jax.tree.map(lambda _: BY_FRAME, batch)
    return by_frame._replace(**dict.fromkeys(_POINT_LEAVES, BY_POINT))


class RowDraw(NamedTuple):
    """How rows of `FrameData` are drawn: from all but the last `held` frames, or from those.

    `several`: how many of the `points` of a frame come from rows with several roots.
    """

    frames: int
    points: int
    several: int
    held: int

    def chosen(self, data: FrameData, key: PRNGKeyArray) -> Int[Array, " B"]:
        """Random frames to learn from."""
        return jax.random.randint(key, (self.frames,), 0, data.num_frames - self.held)


class AbstractDraw(eqx.Module):
    """Draws points of random frames, with the root that counts for each point.

    `lost_is_outside`: whether a point without a root counts as outside in validation; otherwise
    its root stays where it was seen last.
    """

    rows: eqx.AbstractVar[RowDraw]
    lost_is_outside: eqx.AbstractClassVar[bool]

    def __call__(self, model: AvatarModel, data: FrameData, key: PRNGKeyArray) -> PointBatch:
        frame_key, key = jax.random.split(key)
        return self.of_frames(model, data, self.rows.chosen(data, frame_key), key)

    @abc.abstractmethod
    def of_frames(
        self, model: AvatarModel, data: FrameData, chosen: Int[Array, " B"], key: PRNGKeyArray
    ) -> PointBatch:
        """Random points of these frames."""


class DrawCached(AbstractDraw):
    """Draws points whose roots are cached, and of several roots takes the most inside one."""

    rows: RowDraw = eqx.field(static=True)
    devices: Devices = eqx.field(static=True, default=ONE_DEVICE)
    lost_is_outside: ClassVar[bool] = False

    def of_frames(
        self, model: AvatarModel, data: FrameData, chosen: Int[Array, " B"], key: PRNGKeyArray
    ) -> PointBatch:
        """Random points of these frames, all from rows that had a root when searched."""
        cache = data.roots
        assert cache is not None
        # A frame without rows of several roots gives its first rows, which have one at most.
        first = jnp.minimum(cache.several[chosen], cache.others.shape[1])
        several_key, single_key = jax.random.split(key)
        rows = jnp.concatenate(
            [
                _uniform_index(several_key, self.rows.several, 0 * first, jnp.maximum(first, 1)),
                _uniform_index(
                    single_key, self.rows.points - self.rows.several, first, cache.found[chosen]
                ),
            ],
            axis=1,
        )
        batch = _take(data, chosen, rows, cache.first, cache.valid)
        others, others_valid = (
            leaf[chosen[:, None], rows[:, : self.rows.several]]
            for leaf in (cache.others, cache.others_valid)
        )
        batch = self.devices.divide(batch, _specs(batch))
        conditions = jax.vmap(model.geometry.condition)(batch.params)
        x_c, found = jax.vmap(_best_cached, in_axes=(None, 0, 0, 0, 0, 0))(
            model, batch.x_c, batch.found, others, others_valid, conditions
        )
        return batch._replace(x_c=x_c, found=found)


class DrawAndSearch(AbstractDraw):
    """Draws points and searches their roots on the model itself (X-Avatar, section 3.3)."""

    starts: StartTable
    rows: RowDraw = eqx.field(static=True)
    keep: int = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    devices: Devices = eqx.field(static=True, default=ONE_DEVICE)
    lost_is_outside: ClassVar[bool] = True

    def of_frames(
        self, model: AvatarModel, data: FrameData, chosen: Int[Array, " B"], key: PRNGKeyArray
    ) -> PointBatch:
        """Random points of these frames."""
        shape = (len(chosen), self.rows.points)
        rows = jax.random.randint(key, shape, 0, data.samples.x_d.shape[1])
        batch = _take(data, chosen, rows)
        batch = self.devices.divide(batch, _specs(batch))
        x_c, valid = self.devices.apart(
            self._search, (model.skinning, data.guide), batch, _specs(batch)
        )
        conditions = jax.vmap(model.geometry.condition)(batch.params)
        best = jax.vmap(best_root, in_axes=(None, 0, 0, 0))
        x_c, found = best(model.geometry, x_c, valid, conditions)
        return batch._replace(x_c=x_c, found=found)

    def _search(
        self, fields: tuple[AbstractSkinningField, TabulatedSkinning | None], batch: PointBatch
    ) -> tuple[Float[Array, "B M K 3"], Bool[Array, "B M K"]]:
        skinning, guide = jax.lax.stop_gradient(fields)
        solver = Broyden(atol=self.atol, divergence=1.0)

        def one_frame(frame: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            found = search_field(
                skinning,
                *frame,
                self.starts,
                guide=None if guide is None else pose_grid(guide, frame[-1]),
                solver=solver,
                keep=min(self.keep, self.starts.width),
                max_steps=self.max_steps,
            )
            return found.x_c, found.valid

        # Frame by frame: the loops inside end when that frame's points do.
        return jax.lax.map(one_frame, (batch.x_d, batch.part, batch.transforms))


def _take(
    data: FrameData, chosen: Int[Array, " B"], rows: Int[Array, "B M"], *root: Array
) -> PointBatch:
    def take(leaf: Array) -> Array:
        return leaf[chosen[:, None], rows]

    x_d = take(data.samples.x_d)  # pyright: ignore[reportArgumentType]
    x_c, found = map(take, root) if root else (x_d, jnp.ones(rows.shape, bool))
    return PointBatch(
        x_d,
        x_c,
        take(data.samples.part).astype(jnp.int32),  # pyright: ignore[reportArgumentType]
        take(data.samples.distance),  # pyright: ignore[reportArgumentType]
        found,
        data.transforms[chosen],
        jax.tree.map(lambda leaf: leaf[chosen], data.params),
    )


def _uniform_index(
    key: PRNGKeyArray, count: int, low: Int[Array, " B"], high: Int[Array, " B"]
) -> Int[Array, "B n"]:
    """`count` integers a row, from `low` to below `high`."""
    u = jax.random.uniform(key, (low.shape[0], count))
    span = jnp.maximum(high - low, 1)[:, None]
    return low[:, None] + jnp.minimum((u * span).astype(jnp.int32), span - 1)


def _best_cached(
    model: AvatarModel,
    first: Float[Array, "M 3"],
    valid: Bool[Array, " M"],
    others: Float[Array, "Q K 3"],
    others_valid: Bool[Array, "Q K"],
    condition: Any,
) -> tuple[Float[Array, "M 3"], Bool[Array, " M"]]:
    """The best of the cached roots, evaluating the field only at points that have several."""
    rows = others.shape[0]
    if not rows or not others.shape[1]:
        return first, valid
    roots = jnp.concatenate([first[:rows, None], others], axis=1)
    usable = jnp.concatenate([valid[:rows, None], others_valid], axis=1)
    best, found = best_root(model.geometry, roots, usable, condition)
    best = jnp.where(found[:, None], best, first[:rows])
    return jnp.concatenate([best, first[rows:]]), jnp.concatenate([found, valid[rows:]])


class LevelTerm(eqx.Module):
    """The loss of the level at the chosen roots. With `through_root`, it also has the implicit
    derivative with respect to the skinning field (X-Avatar, eq. 3 and 9)."""

    through_root: bool = eqx.field(static=True)

    def __call__(
        self, model: AvatarModel, batch: PointBatch, key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        level, used = _levels(model, batch, self.through_root)
        used = used & batch.found
        loss = jnp.where(used, model.link.loss(level, batch.distance), 0.0)
        return loss.sum(), used.sum()


def _levels(
    model: AvatarModel, batch: PointBatch, through_root: bool
) -> tuple[Float[Array, "B M"], Bool[Array, "B M"]]:
    """Levels at the roots, and where the map is regular: elsewhere a root has no derivative."""

    def one(x_c: Array, x_d: Array, transforms: Array, condition: Any) -> tuple[Array, Array]:
        regular = jnp.ones((), bool)
        if through_root:
            x_c, _, regular = implicit_root(x_c, x_d, model.skinning, transforms)
        return model.geometry(x_c, condition).level, regular

    conditions = jax.vmap(model.geometry.condition)(batch.params)
    over_points = jax.vmap(one, in_axes=(0, 0, None, None))
    return jax.vmap(over_points)(batch.x_c, batch.x_d, batch.transforms, conditions)


class BoneTerm(eqx.Module):
    """Points on the canonical bones are inside (X-Avatar, eq. 10).

    They are shared out among the conditions of the batch's frames.
    """

    joints: Float[Array, "J 3"]
    tree: KinematicTree = eqx.field(static=True)

    def __call__(
        self, model: AvatarModel, batch: PointBatch, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        inside = bone_points(self.tree, self.joints, key)
        frames = batch.x_d.shape[0]
        share = -(-len(inside) // frames)
        padded = jnp.resize(inside, (share * frames, 3)).reshape(share, frames, 3)
        conditions = jax.vmap(model.geometry.condition)(batch.params)
        over_frames = jax.vmap(lambda x, c: model.geometry(x, c).level)
        levels = jax.vmap(over_frames, in_axes=(0, None))(padded, conditions)
        return model.link.inside_loss(levels.reshape(-1)[: len(inside)]).mean()


class JointTerm(eqx.Module):
    """At a joint, its two bones share the weight (X-Avatar, eq. 11)."""

    joints: Float[Array, "J 3"]
    tree: KinematicTree = eqx.field(static=True)

    def __call__(self, model: AvatarModel, batch: Any, key: PRNGKeyArray) -> Float[Array, ""]:
        where, hot = joint_targets(self.tree)
        weights = jax.vmap(model.skinning)(self.joints)[where]
        return ((weights - jnp.asarray(hot, weights.dtype)) ** 2).mean()


class SurfaceWeightsTerm(eqx.Module):
    """On the body's canonical surface, the template's weights hold (X-Avatar, eq. 12).

    `count` vertices are drawn for a step (0: all).
    """

    surface: Float[Array, "S 3"]
    weights: Float[Array, "S J"]
    count: int = eqx.field(static=True)

    def __call__(self, model: AvatarModel, batch: Any, key: PRNGKeyArray) -> Float[Array, ""]:
        surface, wanted = self.surface, self.weights
        if self.count:
            pick = jax.random.randint(key, (self.count,), 0, len(surface))
            surface, wanted = surface[pick], wanted[pick]
        return ((jax.vmap(model.skinning)(surface) - wanted) ** 2).mean()


class FoundTerm(eqx.Module):
    """The share of points with a root. It is recorded, and has no gradient."""

    def __call__(self, model: Any, batch: PointBatch, key: PRNGKeyArray) -> Float[Array, ""]:
        return batch.found.mean(dtype=jnp.float32)


class LearnsParts(eqx.Module):
    """Marks the learned leaves of some fields of an `AvatarModel`."""

    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, model: AvatarModel) -> Any:
        nothing = jax.tree.map(lambda _: False, model)
        return eqx.tree_at(
            lambda m: [getattr(m, name) for name in self.names],
            nothing,
            [learned_leaves(getattr(model, name)) for name in self.names],
        )


@lru_cache
def optimiser_of(options: OptimiserConfig) -> optax.GradientTransformation:
    """Adam after a global-norm clip, with a learning rate for each field.

    Cached: optax transformations compare by identity, and equal ones share compiled programs.
    """

    def by_field(model: AvatarModel) -> Any:
        return AvatarModel(*(
            jax.tree.map(lambda _, name=name: name, getattr(model, name))
            for name in ("skinning", "geometry", "link", "color")
        ))  # fmt: skip

    rates = {"skinning": options.skinning_rate, "geometry": options.learning_rate}
    rates |= dict.fromkeys(("link", "color"), options.learning_rate)
    parts = [
        optax.clip_by_global_norm(options.clip),
        optax.scale_by_adam(eps=options.epsilon),
        optax.partition(
            {name: optax.scale_by_learning_rate(rate) for name, rate in rates.items()}, by_field
        ),
    ]
    if options.warmup:
        rise = optax.linear_schedule(1 / options.warmup, 1.0, options.warmup - 1)
        parts.append(optax.scale_by_schedule(rise))
    return optax.chain(*parts)


def weight_terms(body: BodyModel, betas: Any, losses: LossConfig) -> Terms:
    """The terms that hold the skinning field at the person's joints and surface."""
    chosen = np.arange(body.num_vertices)
    if losses.surface_parts == "hands_face":
        parts = body.parts
        rows = np.flatnonzero(parts.mask("hands") | (parts.labels == parts.index("face")))
        chosen = rows if len(rows) else chosen
    vertices = np.asarray(canonical_vertices(body, betas), np.float32)[chosen]
    weights = np.asarray(body.weights, np.float32)[chosen]
    joints = jnp.asarray(canonical_joints(body, betas), jnp.float32)
    surface = SurfaceWeightsTerm(jnp.asarray(vertices), jnp.asarray(weights), losses.surface_points)
    return {
        "joint": (losses.joint, JointTerm(joints, body.tree)),
        "surface": (losses.surface, surface),
    }


def training_stages(
    body: BodyModel,
    betas: Any,
    data: FrameData,
    *,
    search: SearchConfig,
    losses: LossConfig,
    optimiser: OptimiserConfig,
    frames: int,
    points: int,
    skinning_points: int,
    skinning_every: int,
    learn_skinning: bool,
    held: int = 0,
    devices: Devices = ONE_DEVICE,
    extra: Terms | None = None,
) -> tuple[Stage, ...]:
    """The stages of a run.

    With cached roots, the geometry takes most steps and the skinning field every
    `skinning_every`-th; with a search in the step, both are updated together. The last `held`
    frames are never drawn. `extra` terms are added to every stage.

    **Raises:** `ValueError` for an extra term with the name of one of ours.
    """
    extra = dict(extra or {})
    taken = [name for name in extra if name.removeprefix("skinning_") in OWN_TERMS]
    if taken:
        raise ValueError(f"a term cannot be named {taken[0]!r}: the log uses that name")
    points = min(points, data.samples.x_d.shape[1])
    betas = jnp.asarray(betas)
    joints = jnp.asarray(canonical_joints(body, betas), jnp.float32)
    on_weights = weight_terms(body, betas, losses) if learn_skinning else {}
    bone = (losses.bone, BoneTerm(joints, body.tree))
    schedule = FALLING if optimiser.schedule == "cosine" else CONSTANT

    def stage(name: str, learns: tuple[str, ...], draw: Any, terms: Terms, **more: Any) -> Stage:
        return Stage(
            name, draw, {**terms, **extra}, optimiser_of(optimiser), LearnsParts(learns), schedule,
            **more,
        )  # fmt: skip

    if not search.cached:
        draw = DrawAndSearch(
            starts=start_table(body, search.starts),
            rows=RowDraw(frames, points, 0, held),
            keep=search.keep,
            atol=search.atol,
            max_steps=search.max_steps,
            devices=devices,
        )
        level = LevelTerm(through_root=learn_skinning)
        terms = {"occupancy": (1.0, level), "bone": bone, **on_weights, "found": (0.0, FoundTerm())}
        learns = ("skinning", "geometry") if learn_skinning else ("geometry",)
        return (stage("fields", learns, draw, terms),)
    several = rows_with_several(data, points)
    draw = DrawCached(RowDraw(frames, points, several, held), devices)
    terms = {"occupancy": (1.0, LevelTerm(through_root=False)), "bone": bone}
    stages = [stage("geometry", ("geometry",), draw, terms)]
    if learn_skinning:
        count = min(skinning_points, points)
        draw = DrawCached(RowDraw(frames, count, min(several, count), held), devices)
        terms = {"occupancy": (1.0, LevelTerm(through_root=True)), **on_weights}
        stages.append(
            stage("skinning", ("skinning",), draw, terms, every=skinning_every, prefix="skinning_")
        )
    return tuple(stages)


def rows_with_several(data: FrameData, points: int) -> int:
    """How many of a frame's drawn points come from rows with several roots: their share."""
    assert data.roots is not None
    return min(int(np.ceil(points * float(data.roots.share))), points)


class ValidationLoss(eqx.Module):
    """The loss of the level on the last `held` frames, at points that are the same in every call.

    No point leaves the loss by becoming worse: one where the map folds counts with the root that
    was found, one that lost its cached root with the last place of that root, and one for which a
    search finds nothing counts as outside.
    """

    draw: AbstractDraw
    link: AbstractLink

    def __call__(self, model: AvatarModel, data: FrameData) -> Float[Array, ""]:
        held = self.draw.rows.held
        chosen = jnp.arange(data.num_frames - held, data.num_frames)
        batch = self.draw.of_frames(model, data, chosen, jax.random.key(0x5EED))
        level, _ = _levels(model, batch, through_root=True)
        if self.draw.lost_is_outside:
            level = jnp.where(batch.found, level, self.link.outside)
        return self.link.loss(level, batch.distance).mean()


def validation_loss(
    stages: tuple[Stage, ...], data: FrameData, link: AbstractLink, *, points: int, held: int
) -> Callable[[Any, Any], Float[Array, ""]]:
    """The validation loss of a run with these stages."""
    draw: Any = stages[0].draw
    points = min(points, data.samples.x_d.shape[1])
    several = rows_with_several(data, points) if data.roots is not None else 0
    rows = RowDraw(held, points, several, held)
    return ValidationLoss(replace(draw, rows=rows), link)
