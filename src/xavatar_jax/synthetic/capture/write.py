"""Write the bundled capture in GRAB's layout, and read it back as GRAB."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...body import BodyModel, rest_vertices
from ...datasets import Capture, load_grab
from ...files import atomic_folder, cache_path, cached
from ...motion import Motion, save_amass
from ..body import synthetic_body
from .animate import animate
from .floor import on_floor
from .sequences import TEST_SEQUENCES, TRAIN_SEQUENCES

# The key of the cache entry, together with the body's checksum. Change it whenever the motions
# change; tests/synthetic compares them with a recorded checksum.
SYNTHETIC_CAPTURE_VERSION = "1"

T = TypeVar("T")
FPS = 30.0
_SEED = 20
# Direction of the person's shape; `subject_betas` scales it.
_SHAPE_DIRECTION = np.array([-0.9, 0.8, -0.5, 0.4, 0.5, 0.7, -0.4, 0.3, 0.6, 0.5])
_SHAPE_MEDIAN_M = 0.014


def subject_betas(body: BodyModel) -> Float[np.ndarray, " S"]:
    """Shape of the captured person, whose vertices are a median of 14 mm from the mean shape."""
    betas = np.zeros(min(body.num_betas, len(_SHAPE_DIRECTION)))
    betas[:] = _SHAPE_DIRECTION[: len(betas)]
    own, mean = (rest_vertices(body, jnp.asarray(b)) for b in (betas, 0 * betas))
    offset = np.asarray(own) - np.asarray(mean)
    median = float(np.median(np.linalg.norm(offset, axis=1)))
    if median == 0.0:
        raise ValueError(
            f"The body ({body.source.describe()}) has no shape directions, which the captured "
            "person's shape needs."
        )
    return np.round(betas * _SHAPE_MEDIAN_M / median, 4)


def synthetic_motions(body: BodyModel) -> dict[str, dict[str, Motion]]:
    """The motions of the capture, y-up, by split ("train", "test") and name.

    Args:
        body: a body on the SMPL-X tree; the motion depends on its proportions.

    Raises:
        ValueError: the body has other joints, or no shape directions.
    """
    lacking = [n for n in ("left_wrist", "left_thumb3", "jaw") if n not in body.tree.names]
    if lacking:
        raise ValueError(
            f"The bundled motions are for bodies on the SMPL-X tree; this one "
            f"({body.source.describe()}) lacks {', '.join(lacking)}."
        )
    betas = subject_betas(body)
    motions: dict[str, dict[str, Motion]] = {}
    for part, written in (("train", TRAIN_SEQUENCES), ("test", TEST_SEQUENCES)):
        motions[part] = {}
        for i, (name, keys) in enumerate(written.items()):
            seed = _SEED + i + (100 if part == "test" else 0)
            motion = animate(keys(), body, betas, fps=FPS, seed=seed)
            motions[part][name] = on_floor(motion, body)
    return motions


def write_synthetic_capture(folder: str | Path, body: BodyModel) -> Path:
    """Write the capture as `FOLDER/train/*.npz` and `FOLDER/test/*.npz`, AMASS layout, z-up.

    Args:
        folder: must not exist; it is created complete or not at all.
        body: a body on the SMPL-X tree.

    Returns:
        The folder.

    Raises:
        FileExistsError: the folder exists already.
        ValueError: the body does not fit (see `synthetic_motions`).
    """
    folder = Path(folder).expanduser()
    if folder.exists():
        raise FileExistsError(f"{folder} exists already; remove it or choose another folder.")
    with atomic_folder(folder) as temporary:
        _write(temporary, body)
    return folder


def synthetic_capture(
    cache: str | Path | None = None, body: BodyModel | None = None, *, verbose: bool = False
) -> Capture:
    """The bundled capture: nine training and three held-out sequences of one person.

    Written to the cache folder on first use, then read by `load_grab` like any GRAB subject. A
    damaged or incomplete cache entry is written again, with a `CacheNotice`.

    Args:
        cache: overrides the user's cache folder.
        body: a body on the SMPL-X tree; None for the bundled one.
        verbose: show a progress bar.
    """
    body = synthetic_body(cache) if body is None else body
    return _cached(cache, body, lambda folder: load_grab(folder, body, verbose=verbose))


def synthetic_capture_folder(
    cache: str | Path | None = None, body: BodyModel | None = None
) -> Path:
    """The folder of the bundled capture, with `train/*.npz` and `test/*.npz`, in the cache."""
    body = synthetic_body(cache) if body is None else body
    return _cached(cache, body, lambda folder: folder)


def _cached(cache: str | Path | None, body: BodyModel, read: Callable[[Path], T]) -> T:
    name = f"synthetic_capture-{SYNTHETIC_CAPTURE_VERSION}-{body.source.checksum[:12]}"
    return cached(cache_path(cache) / name, lambda folder: _write(folder, body), read, folder=True)


def _write(folder: Path, body: BodyModel) -> None:
    for part, named in synthetic_motions(body).items():
        for name, motion in named.items():
            save_amass(folder / part / f"{name}_stageii.npz", motion.to_z_up(body))
