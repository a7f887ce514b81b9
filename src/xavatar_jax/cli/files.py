"""Inputs and outputs named on a command line: bodies, avatars, motions, captures, output paths."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import xavatar_jax as xa

from .options import Data, Driven, Reading

if TYPE_CHECKING:
    from ..avatar import Avatar, BodyOnlyAvatar
    from ..body import BodyModel
    from ..datasets import Capture
    from ..motion import Motion

# Names what comes with the library instead of a file.
BUNDLED = "bundled"


def read_body(file: Path, gender: str | None = None) -> BodyModel:
    """The body model in a file or folder of models; the bundled body for `bundled`."""
    if _is_bundled(file):
        return xa.synthetic_body()
    return xa.load_body(file, gender=gender or "neutral")


def read_avatar_body(avatar: Path, body: Path | None) -> BodyModel:
    """The body that an avatar file names, or the model in the file `body`."""
    from ..avatar import load_avatar_body, needs_bundled_body

    bundled = needs_bundled_body(avatar) if body is None else _is_bundled(body)
    return xa.synthetic_body() if bundled else load_avatar_body(avatar, body)


def read_avatar(
    file: Path, body: Path | None = None, template: Path | None = None
) -> Avatar | BodyOnlyAvatar:
    """An avatar on its body or the one in the file `body`, with the person's template if given."""
    from ..body import with_template
    from ..files.meshes import read_mesh

    model = read_avatar_body(file, body)
    if template is not None:
        model = with_template(model, read_mesh(template)[0])
    return xa.load_avatar(file, body=model)


def read_motion(file: Path, reading: Reading, body: BodyModel | None) -> Motion:
    """A motion from a file or folder, or a bundled one: `bundled` or `bundled:NAME`."""
    return xa.load_motion(
        _bundled_motion(file) if _is_bundled(file) else file,
        body=body,
        format=reading.read_as,
        fps=reading.file_fps,
        up=reading.file_up,
        person=reading.person,
        flat_hand_mean=reading.flat_hand_mean,
        joint_map=reading.joint_map,
        scale=reading.scale,
    )


def read_driven(
    file: Path, options: Driven, body: BodyModel, fastest: float | None = None
) -> Motion:
    """A motion, y up, cut and resampled as the options ask.

    Without `--fps` it keeps its frame rate, limited to `fastest`.
    """
    motion = read_motion(file, options.reading, body).to_y_up(body)
    fps = options.fps
    if fps is None and fastest is not None:
        fps = min(motion.fps, fastest)
    return cut_motion(motion, options.start, options.end, fps)


def cut_motion(motion: Motion, start: float | None, end: float | None, fps: float | None) -> Motion:
    """A motion from `start` to `end`, in seconds, resampled to `fps`."""
    if start is not None or end is not None:
        motion = motion.trim(start or 0.0, end)
    return motion if fps is None else motion.resample(fps)


def check_frame(frame: int, motion: Motion) -> int:
    """The value of `--frame`. **Raises:** `ValueError` if the motion has no such frame."""
    if not 0 <= frame < len(motion):
        raise ValueError(f"--frame {frame}: {motion.source} has frames 0 to {len(motion) - 1}")
    return frame


def read_capture(
    options: Data, body: BodyModel, *, seed: int, verbose: bool, cache: Path | None = None
) -> Capture:
    """The capture in the folder `options.data`, or the bundled one."""
    if options.data is None:
        return xa.synthetic_capture(cache, body=body, verbose=verbose)
    return xa.load_data(
        options.data,
        body,
        gender=options.gender,
        test=options.test or None,
        split_seed=seed,
        flat_hand_mean=options.flat_hand_mean,
        verbose=verbose,
    )


def count_of(text: str) -> int | None:
    """A number of frames, or None for "all". **Raises:** `ValueError` for anything else."""
    if text == "all":
        return None
    if not text.isdigit() or int(text) == 0:
        raise ValueError(f'--eval-frames {text}: a number above zero or "all" is needed')
    return int(text)


def check_output(path: Path, kind: Literal["file", "folder", "new folder"] = "file") -> None:
    """Check, before any work is done, that an output can be written.

    **Raises:** `OSError` if a file is to replace a folder, a new folder exists already, or the
    nearest existing folder above `path` is not writable.
    """
    if kind == "file" and path.is_dir():
        raise IsADirectoryError(f"{path}: this is a folder; give a file name")
    if kind == "new folder" and path.exists():
        raise FileExistsError(f"{path}: already exists; name a new folder, or remove this one")
    above = path.absolute() if kind == "folder" else path.absolute().parent
    while not above.exists() and above != above.parent:
        above = above.parent
    if not above.is_dir():
        raise NotADirectoryError(f"{path}: cannot be written, because {above} is not a folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: cannot be written, because {above} is not writable")


def written(path: Path | str, what: str = "", *, quiet: bool) -> None:
    """Report on stdout what was written."""
    if not quiet:
        print(f"{path}: {what}" if what else str(path), flush=True)


def _is_bundled(file: Path) -> bool:
    return file.name.partition(":")[0] == BUNDLED and len(file.parts) == 1 and not file.exists()


def _bundled_motion(file: Path) -> Path:
    from ..synthetic import synthetic_capture_folder

    folder = synthetic_capture_folder()
    files = [*sorted(folder.glob("test/*.npz")), *sorted(folder.glob("train/*.npz"))]
    named = {path.stem.removesuffix("_stageii"): path for path in files}
    name = file.name.partition(":")[2] or next(iter(named))
    if name not in named:
        raise ValueError(f"no bundled motion {name!r}; there are {', '.join(named)}")
    return named[name]
