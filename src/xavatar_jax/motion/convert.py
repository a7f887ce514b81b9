"""Between a motion and the parameters of a body."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..body import BodyParams
from ..body.params import MAX_DEFAULT_COEFFICIENTS

if TYPE_CHECKING:
    from ..body import BodyModel
    from .record import Motion, UpAxis


class MotionNotice(UserWarning):
    """Something of a motion was assumed, filled in, cut or left out."""


def fit_size(
    values: Float[np.ndarray, "*batch n"],
    limit: int,
    name: str,
    source: str,
    holder: str = "the body",
) -> tuple[Float[np.ndarray, "*batch m"], str | None]:
    """Cut the last axis to `limit`, or fill it with zeros to ten as far as `limit` allows.

    Zeros change no body, so only cutting coefficients that are not zero gives a notice.
    """
    found = values.shape[-1]
    if found <= limit:
        missing = max(min(MAX_DEFAULT_COEFFICIENTS, limit) - found, 0)
        return np.concatenate([values, np.zeros((*values.shape[:-1], missing))], -1), None
    notice = None
    if np.any(values[..., limit:] != 0):
        notice = (
            f"{source}: {found} {name} given, {holder} has {limit}; the last {found - limit} cut."
        )
    return values[..., :limit], notice


def shape_for(motion: Motion, body: BodyModel) -> tuple[Float[np.ndarray, " S"], str | None]:
    """The motion's shape coefficients if they are of the body's model, else none and a notice."""
    if motion.model in ("unknown", body.kind) or not motion.betas.any():
        return motion.betas, None
    return np.zeros(0), (
        f"{motion.source}: betas are of {motion.model} and mean nothing to the {body.kind} body; "
        "its mean shape is used."
    )


def to_params(motion: Motion, body: BodyModel) -> BodyParams:
    """As `fit_to_body`, warning (`MotionNotice`) of whatever is lost."""
    params, notices = fit_to_body(motion, body)
    for notice in notices:
        warnings.warn(notice, MotionNotice, stacklevel=3)
    return params


def fit_to_body(motion: Motion, body: BodyModel) -> tuple[BodyParams, list[str]]:
    """Parameters of `body` for every frame, joints matched by name, and notices.

    Joints of the body that the motion lacks stay at zero. Coefficients are cut or filled to the
    body's number. The notices say what is thereby lost.

    Args:
        motion: the motion; its world is kept, so turn it before (`Motion.to_y_up`).
        body: the body.

    Raises:
        ValueError: the motion and the body have no joint in common.
    """
    names = body.tree.names
    shared = [name for name in names if name in motion.joint_names]
    if not shared:
        raise ValueError(
            f"{motion.source}: no joint of the motion ({', '.join(motion.joint_names[:4])}, ...) "
            f"is a joint of the body ({', '.join(names[:4])}, ...)."
        )
    pose = np.zeros((len(motion), len(names), 3))
    notices = []
    for name in shared:
        pose[:, names.index(name)] = motion.joint(name)
    missing = [name for name in names if name not in shared]
    if missing:
        notices.append(
            f"{motion.source}: no rotations for {len(missing)} joints of the body "
            f"({', '.join(missing[:4])}{', ...' if len(missing) > 4 else ''}); they stay at zero."
        )
    dropped = [n for n in motion.joint_names if n not in names and np.any(motion.joint(n))]
    if dropped:
        notices.append(
            f"{motion.source}: {len(dropped)} moving joints are not in the body "
            f"({', '.join(dropped[:4])}{', ...' if len(dropped) > 4 else ''}); they are left out."
        )
    betas, model_notice = shape_for(motion, body)
    betas, betas_notice = fit_size(betas, body.num_betas, "betas", motion.source)
    expression, expression_notice = fit_size(
        np.asarray(motion.expression), body.num_expression, "expression coefficients", motion.source
    )
    notices += [n for n in (model_notice, betas_notice, expression_notice) if n]
    params = BodyParams(
        pose=jnp.asarray(pose, float),
        betas=jnp.asarray(np.broadcast_to(betas, (len(motion), len(betas))), float),
        expression=jnp.asarray(expression, float),
        transl=jnp.asarray(motion.transl, float),
        tree=body.tree,
    )
    return params, notices


def from_params(
    params: BodyParams, *, fps: float, up: UpAxis = "y", gender: str = "neutral", source: str
) -> Motion:
    """The motion that batched parameters describe.

    Args:
        params: parameters batched over T frames of one person.
        fps: frames a second.
        up: the world axis that points up.
        gender: of the body the parameters are for.
        source: named in messages.

    Raises:
        ValueError: the parameters have no single batch axis, or their betas differ by frame.
    """
    from .record import Motion

    pose = np.asarray(params.pose, np.float64)
    if pose.ndim != 3:
        raise ValueError(f"{source}: pose has shape {pose.shape}, expected (T, J, 3).")
    betas = np.asarray(params.betas, np.float64).reshape(len(pose), -1)
    difference = np.abs(betas - betas[:1]).max(initial=0.0)
    if difference > 1e-5:
        raise ValueError(
            f"{source}: betas differ between frames by up to {difference:.3g}; a motion is of one "
            "person. Give one shape for all frames, for example the mean."
        )
    return Motion(
        poses=pose,
        transl=np.asarray(params.transl),
        joint_names=params.tree.names,
        fps=fps,
        betas=betas[0],
        expression=np.asarray(params.expression),
        up=up,
        gender=gender,
        source=source,
    )
