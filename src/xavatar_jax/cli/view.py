"""`xavatar view`: an avatar in the browser, or as one self-contained page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from .files import check_output, read_avatar, read_driven, written
from .options import Driven, Flag, OptionalPath, arg


@dataclass
class Options(Driven):
    """Pose an avatar with sliders in the browser, or play a motion. Stop with Ctrl-C.

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of the library.
    """

    avatar: Positional[Path]
    """Avatar file written by `xavatar fit`."""
    motion: OptionalPath = None
    """Motion to play (default: the rest pose)."""
    html: Annotated[Path | None, arg(metavar="FILE.html", help_behavior_hint="")] = None
    """Page to write instead of starting a viewer; it needs no server and no network."""
    port: int = 8080
    """Port of the viewer; the next free one if it is taken."""
    host: str = "localhost"
    """Address that the viewer listens on; 0.0.0.0 serves the whole network."""
    open: Flag = False
    """Open the viewer in the browser of this machine."""


def run(options: Options) -> None:
    """Show the avatar until Ctrl-C, or write the page."""
    from ..viewer import view, view_html

    if options.html is not None:
        check_output(options.html)
    avatar = read_avatar(options.avatar, options.body, options.template)
    motion = None
    if options.motion is not None:
        motion = read_driven(options.motion, options, avatar.body)
    if options.html is not None:
        view_html(options.html, avatar, motion, title=options.avatar.stem)
        written(options.html, "a self-contained page", quiet=options.quiet)
        return
    with view(
        avatar,
        motion,
        port=options.port,
        host=options.host,
        open=options.open,
        verbose=not options.quiet,
    ) as viewer:
        viewer.wait()
