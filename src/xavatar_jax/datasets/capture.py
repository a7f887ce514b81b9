"""`Capture`, and the split, shape and gender rules shared by all loaders."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import BodyModel, BodyParams
from ..frames import Frames

NUM_TRAIN, NUM_TEST = 9, 3  # sequences, as in X-Avatar's experiments on GRAB


class CaptureNotice(UserWarning):
    """An assumption about a capture, or data that differs from what was expected."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Frames of one person, split into training and test.

    Attributes:
        name: name of the subject or folder.
        body: the body the parameters are for, with the subject's own template if there is one.
        train, test: frames, y-up, metres.
        betas: the shape of the person.
        gender: "neutral", "male", "female", or "unknown".
        fps: frames per second; NaN if unknown, or if the sequences differ.
        notices: what was assumed or changed while loading.
    """

    name: str
    body: BodyModel
    train: Frames
    test: Frames
    betas: Float[np.ndarray, " S"]
    gender: str
    fps: float
    notices: tuple[str, ...] = ()


def notify(notices: Sequence[str]) -> tuple[str, ...]:
    """Issue each notice as a warning, and return them all."""
    for notice in notices:
        warnings.warn(notice, CaptureNotice, stacklevel=3)
    return tuple(notices)


def split_names(
    names: Sequence[str], *, test: Sequence[str] | None, seed: int, source: str | Path
) -> tuple[list[str], list[str]]:
    """Split sequences into training and test, by name or at random.

    Twelve or more are sampled down to nine and three, as in the paper; fewer are split 3:1.

    Args:
        names: all sequences.
        test: sequences to hold out; all others are for training. None to choose by `seed`.
        seed: random seed.
        source: the folder, for messages.

    Raises:
        ValueError: a name in `test` is unknown, or one part would be empty.
    """
    if test is not None:
        unknown = [name for name in test if name not in names]
        if unknown or not test:
            raise ValueError(
                f"{source}: test sequences {', '.join(unknown) or 'none'} not found; "
                f"there are {', '.join(names)}."
            )
        train = [name for name in names if name not in test]
        if not train:
            raise ValueError(
                f"{source}: all {len(names)} sequences are held out; none to train on."
            )
        return train, list(test)
    if len(names) < 2:
        raise ValueError(
            f"{source}: only {len(names)} sequence, which cannot be split by sequence into "
            "training and test; add another."
        )
    order = [sorted(names)[i] for i in np.random.default_rng(seed).permutation(len(names))]
    held = NUM_TEST if len(names) >= NUM_TRAIN + NUM_TEST else max(round(len(names) / 4), 1)
    train = order[held : held + NUM_TRAIN] if held == NUM_TEST else order[held:]
    return sorted(train), sorted(order[:held])


def one_shape(
    shapes: Mapping[str, Float[np.ndarray, " S"]], tolerance: float = 1e-4
) -> tuple[Float[np.ndarray, " S"], str | None]:
    """One shape for a subject: the common shape if they agree, else their mean and a notice.

    Args:
        shapes: betas by source; shorter ones are padded with zeros.
        tolerance: largest difference from the mean that counts as agreement.
    """
    size = max(len(betas) for betas in shapes.values())
    stacked = np.stack([np.pad(b, (0, size - len(b))) for b in shapes.values()])
    mean = stacked.mean(axis=0)
    difference = np.abs(stacked - mean).max(axis=1, initial=0.0)
    if difference.max() <= tolerance:
        return stacked[0], None
    worst = list(shapes)[int(difference.argmax())]
    return mean, (
        f"{len(shapes)} betas of one subject differ (by up to {difference.max():.3g} from their "
        f"mean, in {worst}); the mean is used for all. Meshes of one person are assumed."
    )


def resolve_gender(
    found: Mapping[str, str], body: BodyModel, override: str | None, source: str | Path
) -> tuple[str, list[str]]:
    """The subject's gender from its files, checked against the body's.

    Args:
        found: gender by source, as the files state it.
        body: its `source.gender` must be the subject's.
        override: overrides what the files state.
        source: the folder, for messages.

    Raises:
        ValueError: without `override`, the files disagree with one another or with the body;
            or `override` disagrees with the body.
    """
    known = {name: gender for name, gender in found.items() if gender not in ("", "unknown")}
    genders = sorted(set(known.values()))
    if override is not None:
        subject = override.lower()
        notices = [f"{source}: files say {g}, taken as {subject}." for g in genders if g != subject]
    elif len(genders) > 1:
        listing = "; ".join(f"{name}: {gender}" for name, gender in known.items())
        raise ValueError(f"{source}: sequences of different gender ({listing}); pass gender=.")
    else:
        subject, notices = (genders[0] if genders else "unknown"), []
    of_body = body.source.gender
    if "unknown" not in (subject, of_body) and subject != of_body:
        which = "gender asked for" if override is not None else "sequences"
        raise ValueError(
            f"{source}: the {which} is {subject}, but the body ({body.source.describe()}) is "
            f"{of_body}. Load the {subject} body, or pass gender={of_body!r} to use this one."
        )
    return subject, notices


def concatenate_params(parts: Sequence[BodyParams]) -> BodyParams:
    """Join batched parameters along the batch axis, padding coefficients with zeros."""

    def padded(part: BodyParams, name: str) -> Array:
        size = max(getattr(p, name).shape[-1] for p in parts)
        values = getattr(part, name)
        return jnp.pad(values, ((0, 0), (0, size - values.shape[-1])))

    parts = [
        replace(p, betas=padded(p, "betas"), expression=padded(p, "expression")) for p in parts
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
