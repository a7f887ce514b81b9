"""`xavatar animate`: pictures of an avatar that follows a motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from .inputs import read_avatar, read_stretch
from .options import READING_NAMES, Driven, Number, Target, arg
from .outputs import check_file, check_new_folder, written

_FASTEST = 30.0  # more frames a second than this make files large and nothing better
SPOKEN = READING_NAMES


@dataclass
class Options(Driven):
    """Draw an avatar that follows a motion.

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of ours.

    No display is needed.
    """

    avatar: Positional[Path]
    """Avatar file, as `xavatar fit` writes it."""
    motion: Positional[Path]
    """What it is to do."""
    out: Target
    """FILE.webp, FILE.gif, or a new folder for one PNG a frame."""
    size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")] = (512, 512)
    """Of the pictures, in pixels."""
    view: Literal["front", "three_quarter", "left", "back", "right"] = "front"
    """Where to look from."""
    shading: Literal["color", "normal", "flat"] = "color"
    """color: lit, with a shadow on the ground."""
    mode: Literal["fast", "full"] = "fast"
    """fast: skin the canonical surface. full: extract every frame's own; slow."""
    offsets: Literal["cached", "exact", "none"] = "cached"
    """How the surface follows pose and expression in fast mode."""
    fps: Number = field(default=None, kw_only=True)
    """Frames a second; without it the motion's own, 30 at most."""


def run(options: Options) -> None:
    """Draw every frame and write the pictures."""
    from ..report import motion_pictures
    from ..training.progress import progress

    write = _writer(options.out)
    if min(options.size) < 1:
        raise ValueError(f"--size {options.size[0]} {options.size[1]}: at least one pixel a side")
    avatar = read_avatar(options.avatar, options.body, options.template)
    motion = read_stretch(options.motion, options, avatar.body, fastest=_FASTEST)
    animation = avatar.animate(motion, mode=options.mode, offsets=options.offsets)
    pictures = motion_pictures(
        animation, size=options.size, view=options.view, shading=options.shading
    )
    with progress("pictures", len(animation), verbose=not options.quiet, unit="frame") as bar:
        write(_counted(pictures, bar), options.out, animation.fps)
    told = f"{len(animation)} frames, {animation.fps:g} a second"
    written(options.out, told, quiet=options.quiet)


def _counted(pictures: Iterable[Any], bar: Any) -> Iterable[Any]:
    for picture in pictures:
        yield picture
        bar.update(1)


def _writer(out: Path) -> Any:
    """The function that writes pictures to `out`, chosen by its name."""
    from ..render import save_gif_animation, save_webp_animation

    suffix = out.suffix.lower()
    writers: dict[str, Any] = {
        ".webp": save_webp_animation,
        ".gif": save_gif_animation,
        "": _save_folder,
    }
    if suffix not in writers:
        raise ValueError(
            f"{out}: pictures are written to .webp, .gif or a folder of PNG files, not to {suffix}"
            + (
                ". ffmpeg makes a film of a folder: docs/command-line.md"
                if suffix == ".mp4"
                else ""
            )
        )
    (check_file if suffix else check_new_folder)(out)
    return writers[suffix]


def _save_folder(pictures: Iterable[Any], folder: Path, fps: float) -> None:
    from ..files import atomic_folder
    from ..render import save_png

    with atomic_folder(folder) as temporary:
        for number, picture in enumerate(pictures):
            save_png(temporary / f"frame_{number:04d}.png", picture)
