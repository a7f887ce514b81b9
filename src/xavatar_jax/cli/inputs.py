"""Bodies, avatars, motions and captures that command lines name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import xavatar_jax as xa

from .options import Driven, Reading

if TYPE_CHECKING:
    from ..avatar import Avatar
    from ..body import BodyModel
    from ..datasets import Capture
    from ..motion import Motion

# In place of a file: what comes with the library.
BUNDLED = "bundled"


def read_body(file: Path, gender: str | None = None) -> BodyModel:
    """The body model in a file or folder of models, or the bundled one by that word."""
    if _is_bundled(file):
        return xa.synthetic_body()
    return xa.load_body(file, gender=gender or "neutral")


def read_avatar_body(avatar: Path, body: Path | None) -> BodyModel:
    """The body that an avatar file names, or the model in another place."""
    from ..avatar import load_avatar_body

    if body is not None and _is_bundled(body):
        return xa.synthetic_body()
    return load_avatar_body(avatar, body)


def read_avatar(file: Path, body: Path | None = None, template: Path | None = None) -> Avatar:
    """An avatar on its own body, the model in another place, or that with a person's template."""
    from ..body import with_template
    from ..files.meshes import read_mesh

    model = read_avatar_body(file, body)
    if template is not None:
        model = with_template(model, read_mesh(template)[0])
    return xa.load_avatar(file, body=model)


def read_motion(file: Path, reading: Reading, body: BodyModel | None) -> Motion:
    """A motion from a file or folder, or of the bundled capture: `bundled`, `bundled:NAME`."""
    if _is_bundled(file):
        file = _bundled_motion(file)
    return xa.load_motion(
        file,
        body=body,
        format=reading.read_as,
        fps=reading.file_fps,
        up=reading.file_up,
        person=reading.person,
        flat_hand_mean=reading.flat_hand_mean,
        joint_map=reading.joint_map,
        scale=reading.scale,
    )


def read_stretch(
    file: Path, options: Driven, body: BodyModel, fastest: float | None = None
) -> Motion:
    """The stretch of a motion that the options ask for, y-up.

    Without `--fps` it has its own frame rate, or `fastest` if that is lower.
    """
    motion = read_motion(file, options.reading, body).to_y_up(body)
    fps = options.fps
    if fps is None and fastest is not None:
        fps = min(motion.fps, fastest)
    return cut_motion(motion, options.start, options.end, fps)


def cut_motion(motion: Motion, start: float | None, end: float | None, fps: float | None) -> Motion:
    """A stretch of a motion, in seconds, at another frame rate."""
    if start is not None or end is not None:
        motion = motion.trim(start or 0.0, end)
    return motion if fps is None else motion.resample(fps)


def read_capture(
    data: Path | None,
    body: BodyModel,
    *,
    gender: str | None = None,
    test: tuple[str, ...] = (),
    seed: int = 0,
    flat_hand_mean: bool | None = None,
    cache: Path | None = None,
    verbose: bool = False,
) -> Capture:
    """The capture in a folder, or the bundled one."""
    if data is None:
        return xa.synthetic_capture(cache, body=body, verbose=verbose)
    return xa.load_data(
        data,
        body,
        gender=gender,
        test=test or None,
        split_seed=seed,
        flat_hand_mean=flat_hand_mean,
        verbose=verbose,
    )


def count_of(text: str) -> int | None:
    """A number of frames, or None for "all". **Raises:** `ValueError` for anything else."""
    if text == "all":
        return None
    if not text.isdigit() or int(text) == 0:
        raise ValueError(f'--eval-frames {text}: a number above zero or "all" is needed')
    return int(text)


def _is_bundled(file: Path) -> bool:
    return file.name.partition(":")[0] == BUNDLED and len(file.parts) == 1 and not file.exists()


def _bundled_motion(file: Path) -> Path:
    from ..datasets import synthetic_capture_folder

    folder = synthetic_capture_folder()
    files = [*sorted(folder.glob("test/*.npz")), *sorted(folder.glob("train/*.npz"))]
    named = {path.stem.removesuffix("_stageii"): path for path in files}
    name = file.name.partition(":")[2] or next(iter(named))
    if name not in named:
        raise ValueError(f"no bundled motion {name!r}; there are {', '.join(named)}")
    return named[name]
