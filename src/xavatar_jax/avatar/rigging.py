"""A drivable avatar as a rig: skeleton, weights, expressions as blend shapes, motions as clips."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from ..body import BodyParams, canonical_params, canonical_pose, rest_joints
from ..export import (
    Clip,
    Rig,
    check_glb_path,
    glb_bytes,
    limit_influences,
    write_weights,
)
from ..files import atomic_path
from ..kinematics import TO_Y_UP, KinematicTree
from ..meshing import Mesh
from .animate import (
    Animation,
    MotionLike,
    Spread,
    animate,
    drive_frames,
    skin_columns,
    spread_frames,
)
from .protocol import Drivable

Motions = MotionLike | BodyParams | Mapping[str, MotionLike | BodyParams]
_CHECKED_FRAMES = 24


@dataclass(frozen=True, eq=False)
class GlbExport:
    """The contents of a rigged file, and its error against `animate`, millimetres.

    - `influence_loss`: error from the bones left out, over `checked` frames of the motions; None
      without a motion.
    - `total_loss`: also from what blend shapes miss of expressions, and from the offsets that
      depend on pose, which a rig cannot hold.
    - `expression_scales`: coefficient of expression at a blend shape weight of one.
    """

    path: Path
    num_bytes: int
    num_vertices: int
    num_joints: int
    num_targets: int
    influences: int
    frames: dict[str, int]
    influence_loss: Spread | None
    total_loss: Spread | None
    checked: int
    expression_scales: Float[np.ndarray, " E"]

    def __str__(self) -> str:
        clips = ", ".join(f"{name} ({count} frames)" for name, count in self.frames.items())
        text = (
            f"{self.path}: {self.num_bytes / 1e6:.1f} MB, {self.num_vertices} vertices, "
            f"{self.num_joints} joints, {self.num_targets} blend shapes, clips: {clips or 'none'}"
        )
        if self.influence_loss is None or self.total_loss is None:
            return text
        lost, total = self.influence_loss, self.total_loss
        return (
            f"{text}\n{self.influences} influences a vertex lose {lost.mean:.3f} mm on average, "
            f"{lost.max:.2f} mm at most; with what a rig cannot hold of pose and expression "
            f"{total.mean:.3f} mm, {total.max:.2f} mm at most ({self.checked} frames)"
        )


def export_glb(
    avatar: Drivable,
    path: str | os.PathLike[str],
    motion: Motions | None = None,
    *,
    influences: Literal[4, 8] = 4,
    expressions: bool | int = True,
    colors: UInt8[np.ndarray, "V C"] | None = None,
    up: Literal["y", "z"] | None = None,
    verbose: bool = True,
) -> GlbExport:
    """Write a rigged `.glb`: mesh, skeleton, weights, expressions as blend shapes, clips.

    `motion` is one motion, parameters `(T, ...)` at 30 frames per second, or several by the names
    of their clips. The file is in metres with y up, whatever the up axis of the motions (`up` for
    parameters, default y). Eight `influences` lose less than four; Blender reads them, three.js
    takes the first four. `expressions`: how many coefficients get blend shapes, the first ones
    (True: all; False or 0: none). `colors` are sRGB, one row per vertex of `avatar.rest`, and
    replace the avatar's own.

    The error against `animate` is measured on 24 frames, returned, and printed unless `verbose`
    is false. The file appears whole or not at all.

    **Raises:** `ValueError` for a name that does not end in `.glb`, or as for `animate`;
    `OSError` if the file cannot be written.
    """
    check_glb_path(path)
    with atomic_path(path) as temporary:  # first: an unwritable path must not cost a minute
        animations = {name: animate(avatar, each) for name, each in _named(motion).items()}
        ups = {name: up or getattr(each, "up", "y") for name, each in _named(motion).items()}
        scales = expression_scales(avatar, list(animations.values()), expressions)
        rig = build_rig(avatar, scales, colors=colors)
        clips = [
            build_clip(name, each, rig, scales, ups[name]) for name, each in animations.items()
        ]
        data = glb_bytes(rig, clips, influences=influences)
        losses = measure_losses(rig, list(zip(animations.values(), clips, strict=True)), influences)
        temporary.write_bytes(data)
    report = GlbExport(
        path=Path(path),
        num_bytes=len(data),
        num_vertices=rig.mesh.num_vertices,
        num_joints=rig.tree.num_joints,
        num_targets=len(rig.target_names),
        influences=influences,
        frames={name: len(each) for name, each in animations.items()},
        influence_loss=losses[0],
        total_loss=losses[1],
        checked=losses[2],
        expression_scales=np.zeros(0) if scales is None else scales,
    )
    if verbose:
        print(report)
    return report


def export_weights(avatar: Drivable, path: str | os.PathLike[str]) -> None:
    """See `Avatar.export_weights`."""
    write_weights(path, build_rig(avatar))


def expression_scales(
    avatar: Drivable, animations: list[Animation], expressions: bool | int = True
) -> Float[np.ndarray, " E"] | None:
    """The coefficient at a blend shape weight of one: the largest that occurs, at least 1.

    `expressions`: how many coefficients get blend shapes, the first ones; True: all that move
    the avatar; False: none.

    **Raises:** `ValueError` for more than it has, or fewer than none.
    """
    if expressions is False:
        return None
    count = avatar.rest.num_expression
    if expressions is not True:
        if not 0 <= expressions <= count:
            raise ValueError(
                f"expressions={expressions}; the avatar has {count} coefficients of expression"
            )
        count = expressions
    scales = np.ones(count)
    for animation in animations:
        found = np.abs(np.asarray(animation.params.expression, np.float64)).max(0)[:count]
        scales[: len(found)] = np.maximum(scales[: len(found)], found)
    return scales


def build_rig(
    avatar: Drivable,
    scales: Float[np.ndarray, " E"] | None = None,
    *,
    colors: UInt8[np.ndarray, "V C"] | None = None,
) -> Rig:
    """The rest surface on the canonical skeleton of the avatar's shape.

    With `scales` it has two blend shapes per coefficient of expression, one per sign, so that all
    weights are between 0 and 1: Blender clips others on import.
    """
    rest, tree = avatar.rest, avatar.body.tree
    colors = rest.colors if colors is None else colors
    mesh = Mesh(np.asarray(rest.vertices).T, rest.faces, colors=colors)
    joints = np.asarray(rest_joints(avatar.body, jnp.asarray(avatar.betas)), np.float64)
    scales = np.zeros(0) if scales is None else scales
    return Rig(
        mesh=mesh.compute_normals(),
        weights=np.asarray(rest.weights).T,
        tree=tree,
        rotations=_matrices(np.asarray(canonical_pose(avatar.body))),
        translations=_to_parent(tree, joints[None])[0],
        targets=_expression_targets(avatar, scales),
        target_names=tuple(
            f"expression_{k}_{side}" for side in ("plus", "minus") for k in range(len(scales))
        ),
    )


def _expression_targets(
    avatar: Drivable, scales: Float[np.ndarray, " E"]
) -> Float[np.ndarray, "T V 3"]:
    """How each coefficient moves the neutral vertices: all at +1, then all at -1, scaled."""
    count, surface = len(scales), avatar.rest
    if not count:
        return np.zeros((0, surface.vertices.shape[1], 3))
    neutral = canonical_params(avatar.body, jnp.asarray(avatar.betas))
    unit = np.eye(count, neutral.expression.shape[-1])
    both = np.concatenate([unit, -unit])
    params = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], len(both), 0), neutral)
    params = replace(params, expression=both.astype(params.pose.dtype))
    conditions = drive_frames(surface, avatar.body, params).conditions
    rest = np.asarray(surface.vertices)
    shapes = []
    for k, scale in enumerate(np.tile(scales, 2)):
        condition = jax.tree.map(lambda leaf, k=k: leaf[k], conditions)
        shapes.append(scale * (np.asarray(_under(surface, condition)) - rest).T)
    return np.stack(shapes)


_under = eqx.filter_jit(lambda rest, condition: rest.under(condition))


def build_clip(
    name: str,
    animation: Animation,
    rig: Rig,
    scales: Float[np.ndarray, " E"] | None = None,
    up: str = "y",
) -> Clip:
    """A motion as rotations and translations of the rig's joints, turned so that y is up.

    Expression moves the joints of eyes and jaw a little; their translations follow.

    **Raises:** `ValueError` for another up axis than y and z.
    """
    if up not in TO_Y_UP:
        raise ValueError(f"{name}: up axis {up!r}; it must be 'y' or 'z'")
    params, avatar = animation.params, animation.avatar
    turn = TO_Y_UP[up]
    rotations = _matrices(np.asarray(params.pose))
    joints = jax.vmap(lambda p: rest_joints(avatar.body, p.betas, p.expression))(params)
    translations = _to_parent(rig.tree, np.asarray(joints, np.float64))
    translations[:, 0] = (translations[:, 0] + np.asarray(params.transl)) @ turn.T
    rotations[:, 0] = turn @ rotations[:, 0]
    scales = np.zeros(0) if scales is None else scales
    weights = np.zeros((len(params), len(scales)))
    expression = np.asarray(params.expression, np.float64)[:, : len(scales)]
    weights[:, : expression.shape[1]] = expression
    weights /= scales
    both = np.concatenate([np.maximum(weights, 0), np.maximum(-weights, 0)], axis=1)
    return Clip(name, animation.fps, rotations, translations, both)


def measure_losses(
    rig: Rig, pairs: list[tuple[Animation, Clip]], influences: int
) -> tuple[Spread | None, Spread | None, int]:
    """Error of few influences, of the whole rig, and over how many frames."""
    if not pairs:
        return None, None, 0
    few = jnp.asarray(limit_influences(rig.weights, influences).dense(rig.tree.num_joints).T)
    every = jnp.asarray(rig.weights.T)
    shapes = rig.targets.reshape(len(rig.targets), 3 * rig.mesh.num_vertices)
    by_influence, in_all = [], []
    for animation, clip in pairs:
        for k in spread_frames(len(animation), max(_CHECKED_FRAMES // len(pairs), 1)):
            moved = (clip.coefficients[k] @ shapes).reshape(-1, 3)
            points = jnp.asarray((rig.mesh.vertices + moved).T, jnp.float32)
            transforms = jnp.asarray(animation.drive.transforms[k])
            rigged, skinned = (
                np.asarray(skin_columns(points, w, transforms)) for w in (few, every)
            )
            by_influence.append(np.linalg.norm(rigged - skinned, axis=1))
            in_all.append(np.linalg.norm(rigged - animation.frame_vertices(int(k)), axis=1))
    return Spread.of(np.stack(by_influence)), Spread.of(np.stack(in_all)), len(in_all)


def _named(motion: Motions | None) -> dict[str, Any]:
    if motion is None:
        return {}
    if isinstance(motion, Mapping):
        return {str(name): each for name, each in motion.items()}
    name = Path(getattr(motion, "source", "motion")).stem
    return {name or "motion": motion}


def _matrices(pose: np.ndarray) -> Float[np.ndarray, "... 3 3"]:
    # Not in JAX: it would compile for every number of frames, for a file that is written once.
    from scipy.spatial.transform import Rotation

    writable = np.array(pose, np.float64)  # SciPy refuses the read-only views that JAX gives
    flat = Rotation.from_rotvec(writable.reshape(-1, 3)).as_matrix()
    return flat.reshape(*pose.shape[:-1], 3, 3)


def _to_parent(
    tree: KinematicTree, joints: Float[np.ndarray, "T J 3"]
) -> Float[np.ndarray, "T J 3"]:
    """Rest positions relative to the parent's, whose frames are aligned at rest."""
    parents = np.maximum(np.asarray(tree.parents), 0)
    local = joints - joints[:, parents]
    local[:, 0] = joints[:, 0]
    return local
