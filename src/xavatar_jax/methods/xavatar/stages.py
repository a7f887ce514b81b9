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


class DrawnPoints(NamedTuple):
    """Points of B frames, M each, with the roots known for each.

    - `x_d`: posed, metres; `part`: labels; `distance`: metres, positive inside.
    - `root`: one canonical root a point, metres; `valid`: whether it still is one.
    - `others`: further roots of the first Q points, with `others_valid`. Q may be 0.
    - `neutral`, `others_neutral`: the points that the frame's condition carries to the roots.
    - `transforms`, `params`: of the frames.
    """

    x_d: Float[Array, "B M 3"]
    root: Float[Array, "B M 3"]
    neutral: Float[Array, "B M 3"]
    part: Int[Array, "B M"]
    distance: Float[Array, "B M"]
    valid: Bool[Array, "B M"]
    others: Float[Array, "B Q K 3"]
    others_neutral: Float[Array, "B Q K 3"]
    others_valid: Bool[Array, "B Q K"]
    transforms: Float[Array, "B J 4 4"]
    params: BodyParams


class PointBatch(NamedTuple):
    """Points of B frames, M each, with the root that was chosen for each point.

    - `x_d`: posed, `x_c`: canonical, metres; `part`: labels; `distance`: metres, positive inside.
    - `found`: whether the point has a root; without one, `x_c` is meaningless but finite.
    - `level`: of the geometry at `x_c`; `regular`: whether the root has derivatives.
    - `bone_level`: at points on the canonical bones, if the stage draws them.
    - `transforms`, `params`: of the frames.
    """

    x_d: Float[Array, "B M 3"]
    x_c: Float[Array, "B M 3"]
    part: Int[Array, "B M"]
    distance: Float[Array, "B M"]
    found: Bool[Array, "B M"]
    level: Float[Array, "B M"]
    regular: Bool[Array, "B M"]
    bone_level: Float[Array, " n"] | None
    transforms: Float[Array, "B J 4 4"]
    params: BodyParams


_POINT_LEAVES = ("x_d", "root", "neutral", "part", "distance", "valid")


def _specs(drawn: DrawnPoints) -> DrawnPoints:
    """How the leaves of a draw are divided among devices."""
    by_frame = jax.tree.map(lambda _: BY_FRAME, drawn)
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
    """Draws points of random frames, with their roots.

    `lost_is_outside`: whether a point without a root counts as outside in validation; otherwise
    its root stays where it was seen last.
    """

    rows: eqx.AbstractVar[RowDraw]
    lost_is_outside: eqx.AbstractClassVar[bool]

    def __call__(self, model: AvatarModel, data: FrameData, key: PRNGKeyArray) -> DrawnPoints:
        frame_key, key = jax.random.split(key)
        return self.of_frames(model, data, self.rows.chosen(data, frame_key), key)

    @abc.abstractmethod
    def of_frames(
        self, model: AvatarModel, data: FrameData, chosen: Int[Array, " B"], key: PRNGKeyArray
    ) -> DrawnPoints:
        """Random points of these frames."""


class DrawCached(AbstractDraw):
    """Draws points whose roots are cached."""

    rows: RowDraw = eqx.field(static=True)
    devices: Devices = eqx.field(static=True, default=ONE_DEVICE)
    lost_is_outside: ClassVar[bool] = False

    def of_frames(
        self, model: AvatarModel, data: FrameData, chosen: Int[Array, " B"], key: PRNGKeyArray
    ) -> DrawnPoints:
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
        drawn = _take(data, chosen, rows)
        at = chosen[:, None], rows
        several = chosen[:, None], rows[:, : self.rows.several]
        drawn = drawn._replace(
            root=cache.first[at],
            neutral=cache.neutral[at],
            valid=cache.valid[at],
            others=cache.others[several],
            others_neutral=cache.others_neutral[several],
            others_valid=cache.others_valid[several],
        )
        return self.devices.divide(drawn, _specs(drawn))


class DrawAndSearch(AbstractDraw):
    """Draws points, searches their roots on the model itself and takes the most inside one.

    Source: X-Avatar, section 3.3.
    """

    starts: StartTable
    rows: RowDraw = eqx.field(static=True)
    keep: int = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    devices: Devices = eqx.field(static=True, default=ONE_DEVICE)
    lost_is_outside: ClassVar[bool] = True

    def of_frames(
        self, model: AvatarModel, data: FrameData, chosen: Int[Array, " B"], key: PRNGKeyArray
    ) -> DrawnPoints:
        """Random points of these frames."""
        shape = (len(chosen), self.rows.points)
        rows = jax.random.randint(key, shape, 0, data.samples.x_d.shape[1])
        drawn = _take(data, chosen, rows)
        drawn = self.devices.divide(drawn, _specs(drawn))
        x_c, valid = self.devices.apart(
            self._search, (model.skinning, data.guide), drawn, _specs(drawn)
        )
        conditions = jax.vmap(model.geometry.condition)(drawn.params)
        best = jax.vmap(best_root, in_axes=(None, 0, 0, 0))
        root, valid = best(model.geometry, x_c, valid, conditions)
        inverse = jax.vmap(model.geometry.carried_from, in_axes=(0, None))
        neutral, _ = jax.vmap(inverse)(root, conditions)
        return drawn._replace(root=root, neutral=neutral, valid=valid)

    def _search(
        self, fields: tuple[AbstractSkinningField, TabulatedSkinning | None], drawn: DrawnPoints
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
        return jax.lax.map(one_frame, (drawn.x_d, drawn.part, drawn.transforms))


def _take(data: FrameData, chosen: Int[Array, " B"], rows: Int[Array, "B M"]) -> DrawnPoints:
    """The samples of some rows, with nothing known of their roots."""
    x_d, part, distance = (leaf[chosen[:, None], rows] for leaf in data.samples)
    return DrawnPoints(
        x_d=x_d,
        root=x_d,
        neutral=x_d,
        part=part.astype(jnp.int32),
        distance=distance,
        valid=jnp.zeros(rows.shape, bool),
        others=(none := jnp.zeros((len(chosen), 0, 1, 3), x_d.dtype)),
        others_neutral=none,
        others_valid=jnp.zeros((len(chosen), 0, 1), bool),
        transforms=data.transforms[chosen],
        params=jax.tree.map(lambda leaf: leaf[chosen], data.params),
    )


def _uniform_index(
    key: PRNGKeyArray, count: int, low: Int[Array, " B"], high: Int[Array, " B"]
) -> Int[Array, "B n"]:
    """`count` integers a row, from `low` to below `high`."""
    u = jax.random.uniform(key, (low.shape[0], count))
    span = jnp.maximum(high - low, 1)[:, None]
    return low[:, None] + jnp.minimum((u * span).astype(jnp.int32), span - 1)


class LevelsAtRoots(eqx.Module):
    """The levels at the roots and at points on the bones: what the terms of a stage share.

    Of several roots, the most inside one counts (X-Avatar, section 3.3).

    - `through_root`: gives levels the implicit derivative with respect to the skinning field
      (X-Avatar, eq. 3 and 9).
    - `joints`: of the neutral bones on which points are drawn, shared out among the conditions
      of the batch's frames; None for no such points.
    """

    through_root: bool = eqx.field(static=True)
    tree: KinematicTree = eqx.field(static=True)
    joints: Float[Array, "J 3"] | None = None

    def __call__(self, model: AvatarModel, drawn: DrawnPoints, key: PRNGKeyArray) -> PointBatch:
        frames = len(drawn.x_d)
        on_bones = jnp.zeros((0, 3), drawn.x_d.dtype)
        if self.joints is not None:
            on_bones = bone_points(self.tree, self.joints, key)
        share = -(-len(on_bones) // frames)
        padded = jnp.resize(on_bones, (share * frames, 3)).reshape(share, frames, 3)
        one_frame = jax.vmap(self._one_frame, in_axes=(None, 0, 1))
        x_c, found, level, regular, bone_level = one_frame(model, drawn, padded)
        return PointBatch(
            x_d=drawn.x_d,
            x_c=x_c,
            part=drawn.part,
            distance=drawn.distance,
            found=found,
            level=level,
            regular=regular,
            bone_level=bone_level.T.reshape(-1)[: len(on_bones)],
            transforms=drawn.transforms,
            params=drawn.params,
        )

    def _one_frame(
        self, model: AvatarModel, drawn: DrawnPoints, on_bones: Float[Array, "S 3"]
    ) -> tuple[Array, Array, Array, Array, Array]:
        geometry, points = model.geometry, len(drawn.root)
        condition = geometry.condition(drawn.params)
        # Levels at single roots are computed below if they go through the root.
        compared = len(drawn.others) if self.through_root else points
        # One call for all points: what a condition costs is paid once, and compiled once.
        places = [drawn.neutral[:compared], drawn.others_neutral.reshape(-1, 3), on_bones]
        level = jax.vmap(lambda x: geometry.carried_value(x, condition).level)(
            jnp.concatenate(places)
        )
        level, bone_level = jnp.split(level, [len(level) - len(on_bones)])

        def by_root(first: Array, others: Array) -> Array:
            """Every root of a point. Only the first points have others: the rest gets zeros."""
            room = ((0, compared - len(others)), *((0, 0),) * (others.ndim - 1))
            return jnp.concatenate([first[:compared, None], jnp.pad(others, room)], axis=1)

        level = by_root(level, level[compared:].reshape(drawn.others_valid.shape))
        valid = by_root(drawn.valid, drawn.others_valid)
        roots = by_root(drawn.root, drawn.others)
        best = jnp.argmax(jnp.where(valid, jax.lax.stop_gradient(level), -jnp.inf), axis=1)

        def chosen(leaf: Array) -> Array:
            index = best.reshape(-1, *(1,) * (leaf.ndim - 1))
            return jnp.take_along_axis(leaf, index, axis=1)[:, 0]

        x_c = jnp.concatenate([chosen(roots), drawn.root[compared:]])
        found = jnp.concatenate([jnp.any(valid, axis=1), drawn.valid[compared:]])
        level, regular = chosen(level), jnp.ones(points, bool)
        if self.through_root:
            refine = jax.vmap(implicit_root, in_axes=(0, 0, None, None))
            x_c, _, regular = refine(x_c, drawn.x_d, model.skinning, drawn.transforms)
            level = jax.vmap(lambda x: geometry(x, condition).level)(x_c)
        return x_c, found, level, regular, bone_level


class LevelTerm(eqx.Module):
    """The loss of the level at the chosen roots that are regular."""

    def __call__(
        self, model: AvatarModel, batch: PointBatch, key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        used = batch.regular & batch.found
        loss = jnp.where(used, model.link.loss(batch.level, batch.distance), 0.0)
        return loss.sum(), used.sum()


class BoneTerm(eqx.Module):
    """Points on the canonical bones are inside (X-Avatar, eq. 10)."""

    def __call__(
        self, model: AvatarModel, batch: PointBatch, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        assert batch.bone_level is not None
        return model.link.inside_loss(batch.bone_level).mean()


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
    schedule = FALLING if optimiser.schedule == "cosine" else CONSTANT

    def stage(
        name: str, learns: tuple[str, ...], draw: AbstractDraw, terms: Terms, *,
        through_root: bool, **more: Any,
    ) -> Stage:  # fmt: skip
        forward = LevelsAtRoots(through_root, body.tree, joints if "bone" in terms else None)
        return Stage(
            name, draw, {"occupancy": (1.0, LevelTerm()), **terms, **extra},
            optimiser_of(optimiser), LearnsParts(learns), schedule, forward=forward, **more,
        )  # fmt: skip

    bone = {"bone": (losses.bone, BoneTerm())}
    if not search.cached:
        draw = DrawAndSearch(
            starts=start_table(body, search.starts),
            rows=RowDraw(frames, points, 0, held),
            keep=search.keep,
            atol=search.atol,
            max_steps=search.max_steps,
            devices=devices,
        )
        terms = {**bone, **on_weights, "found": (0.0, FoundTerm())}
        learns = ("skinning", "geometry") if learn_skinning else ("geometry",)
        return (stage("fields", learns, draw, terms, through_root=learn_skinning),)
    several = rows_with_several(data, points)
    draw = DrawCached(RowDraw(frames, points, several, held), devices)
    stages = [stage("geometry", ("geometry",), draw, bone, through_root=False)]
    if learn_skinning:
        count = min(skinning_points, points)
        draw = DrawCached(RowDraw(frames, count, min(several, count), held), devices)
        stages.append(
            stage(
                "skinning",
                ("skinning",),
                draw,
                on_weights,
                through_root=True,
                every=skinning_every,
                prefix="skinning_",
            )
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
    forward: LevelsAtRoots
    link: AbstractLink

    def __call__(self, model: AvatarModel, data: FrameData) -> Float[Array, ""]:
        held = self.draw.rows.held
        chosen = jnp.arange(data.num_frames - held, data.num_frames)
        key = jax.random.key(0x5EED)
        batch = self.forward(model, self.draw.of_frames(model, data, chosen, key), key)
        level = batch.level
        if self.draw.lost_is_outside:
            level = jnp.where(batch.found, level, self.link.outside)
        return self.link.loss(level, batch.distance).mean()


def validation_loss(
    stages: tuple[Stage, ...], data: FrameData, link: AbstractLink, *, points: int, held: int
) -> Callable[[Any, Any], Float[Array, ""]]:
    """The validation loss of a run with these stages."""
    draw: Any = stages[0].draw
    forward: Any = stages[-1].forward  # through the root, where the skinning field is learned
    points = min(points, data.samples.x_d.shape[1])
    several = rows_with_several(data, points) if data.roots is not None else 0
    rows = RowDraw(held, points, several, held)
    return ValidationLoss(replace(draw, rows=rows), replace(forward, joints=None), link)
