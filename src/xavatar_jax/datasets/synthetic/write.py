"""Writing the bundled capture to disk in GRAB's layout, and reading it back as GRAB."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...body import BodyModel, rest_vertices, synthetic_body
from ...files import atomic_folder, cache_dir
from ...motion import Motion, save_amass
from ..capture import Capture
from ..grab import load_grab
from .animate import animate
from .floor import on_floor
from .sequences import TEST_SEQUENCES, TRAIN_SEQUENCES

FPS = 30.0
_SEED = 20
# Direction of the person's shape; `subject_betas` sets how far along it.
_SHAPE_DIRECTION = np.array([-0.9, 0.8, -0.5, 0.4, 0.5, 0.7, -0.4, 0.3, 0.6, 0.5])
_SHAPE_MEDIAN_M = 0.014


def code_checksum() -> str:
    """A short checksum of the code that makes the motions, so that old ones are not reused."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def subject_betas(body: BodyModel) -> Float[np.ndarray, " S"]:
    """Shape of the captured person: a median vertex lies 14 mm from that of the mean shape."""
    betas = np.zeros(min(body.num_betas, len(_SHAPE_DIRECTION)))
    betas[:] = _SHAPE_DIRECTION[: len(betas)]
    own, mean = (rest_vertices(body, jnp.asarray(b)) for b in (betas, 0 * betas))
    offset = np.asarray(own) - np.asarray(mean)
    median = float(np.median(np.linalg.norm(offset, axis=1)))
    if median == 0.0:
        raise ValueError(
            f"The body ({body.source.describe()}) has no shape directions, so the captured person "
            "cannot have a shape of their own."
        )
    return np.round(betas * _SHAPE_MEDIAN_M / median, 4)


def synthetic_motions(body: BodyModel) -> dict[str, dict[str, Motion]]:
    """The motions of the capture, y-up, by split ("train", "test") and name.

    Args:
        body: a body on the SMPL-X tree; its proportions shape the motion.

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
        folder: made, with its parents; it must not exist. It appears whole, or not at all.
        body: a body on the SMPL-X tree.

    Returns:
        The folder.

    Raises:
        FileExistsError: the folder exists already.
        ValueError: the body does not fit (see `synthetic_motions`).
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists already; remove it or choose another folder.")
    motions = synthetic_motions(body)
    with atomic_folder(folder) as temporary:
        for part, named in motions.items():
            for name, motion in named.items():
                save_amass(temporary / part / f"{name}_stageii.npz", motion.to_z_up(body))
    return folder


def synthetic_capture(
    cache: str | Path | None = None, body: BodyModel | None = None, *, verbose: bool = False
) -> Capture:
    """The bundled capture: nine training and three held-out sequences of one person.

    Written to the cache folder on first use, then read by `load_grab` like any GRAB subject.

    Args:
        cache: takes the place of the user's cache folder.
        body: a body on the SMPL-X tree; None takes the bundled one.
        verbose: show a progress bar.
    """
    body = synthetic_body(cache) if body is None else body
    folder = synthetic_capture_folder(cache, body)
    return load_grab(folder, body, gender=None, verbose=verbose)


def synthetic_capture_folder(
    cache: str | Path | None = None, body: BodyModel | None = None
) -> Path:
    """The folder of the bundled capture, `train/*.npz` and `test/*.npz`; made if missing."""
    body = synthetic_body(cache) if body is None else body
    key = f"synthetic_capture-{code_checksum()}-{body.source.checksum[:12]}"
    folder = cache_dir(cache) / key
    if not folder.is_dir():
        with suppress(FileExistsError):  # another process was quicker
            write_synthetic_capture(folder, body)
    return folder
