"""`xavatar animate`: pictures of an avatar that follows a motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from .files import check_output, read_avatar, read_driven, written
from .options import Driven, Number, Target, arg

_FASTEST = 30.0  # frames per second: a higher rate only makes files larger


@dataclass
class Options(Driven):
    """Render an avatar that follows a motion. No display is needed.

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of the library.
    """

    avatar: Positional[Path]
    """Avatar file written by `xavatar fit`."""
    motion: Positional[Path]
    """Motion to follow."""
    out: Target
    """Output: FILE.webp, FILE.gif, or a new folder for one PNG per frame."""
    size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")] = (512, 512)
    """Image size in pixels."""
    view: Literal["front", "three_quarter", "left", "back", "right"] = "front"
    """Side of the avatar that the camera sees."""
    shading: Literal["color", "normal", "flat"] = "color"
    """Shading of the surface. color: lit, with a shadow on the ground."""
    mode: Literal["fast", "full"] = "fast"
    """fast: skin the canonical surface. full: extract the surface of each frame; slow."""
    offsets: Literal["cached", "exact", "none"] = "cached"
    """How the surface follows pose and expression in fast mode."""
    fps: Number = field(default=None, kw_only=True)
    """Frames per second (default: those of the motion, at most 30)."""


def run(options: Options) -> None:
    """Draw every frame and write the pictures."""
    from ..learning import progress
    from ..report import motion_pictures

    write = _writer(options.out)
    if min(options.size) < 1:
        raise ValueError(
            f"--size {options.size[0]} {options.size[1]}: width and height must be at least one "
            "pixel"
        )
    avatar = read_avatar(options.avatar, options.body, options.template)
    motion = read_driven(options.motion, options, avatar.body, fastest=_FASTEST)
    animation = avatar.animate(motion, mode=options.mode, offsets=options.offsets)
    pictures = motion_pictures(
        animation, size=options.size, view=options.view, shading=options.shading
    )
    with progress("pictures", len(animation), verbose=not options.quiet, unit="frame") as bar:
        write(_counted(pictures, bar), options.out, animation.fps)
    what = f"{len(animation)} frames, {animation.fps:g} per second"
    written(options.out, what, quiet=options.quiet)


def _counted(pictures: Iterable[Any], bar: Any) -> Iterable[Any]:
    for picture in pictures:
        yield picture
        bar.update(1)


def _writer(out: Path) -> Any:
    """The function that writes pictures to `out`, chosen by its suffix."""
    from ..render import save_gif_animation, save_webp_animation

    suffix = out.suffix.lower()
    writers: dict[str, Any] = {
        ".webp": save_webp_animation,
        ".gif": save_gif_animation,
        "": _save_folder,
    }
    if suffix not in writers:
        ffmpeg = ". Use ffmpeg to make a film of a folder: docs/command-line.md"
        raise ValueError(
            f"{out}: pictures can be written to .webp, .gif or a folder of PNG files, not to "
            f"{suffix}{ffmpeg if suffix == '.mp4' else ''}"
        )
    check_output(out, "file" if suffix else "new folder")
    return writers[suffix]


def _save_folder(pictures: Iterable[Any], folder: Path, fps: float) -> None:
    from ..files import atomic_folder
    from ..render import save_png

    with atomic_folder(folder) as temporary:
        for number, picture in enumerate(pictures):
            save_png(temporary / f"frame_{number:04d}.png", picture)
