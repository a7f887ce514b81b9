"""`xavatar view`: an avatar in the browser, or as one page that plays anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from .inputs import read_avatar, read_stretch
from .options import READING_NAMES, Driven, Flag, OptionalPath, arg
from .outputs import check_file, written

SPOKEN = READING_NAMES


@dataclass
class Options(Driven):
    """Pose an avatar by sliders in the browser, or play a motion.

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of ours.

    Ends with Ctrl-C; with --html it writes a page and ends at once.
    """

    avatar: Positional[Path]
    """Avatar file, as `xavatar fit` writes it."""
    motion: OptionalPath = None
    """What it is to do; without one it stands at rest."""
    html: Annotated[Path | None, arg(metavar="FILE.html", help_behavior_hint="")] = None
    """Write one page that needs no server and no network, in place of a viewer."""
    port: int = 8080
    """Of the page; the next free one if it is taken."""
    host: str = "localhost"
    """0.0.0.0 answers every machine of the network."""
    open: Flag = False
    """Open the page in the browser of this machine."""


def run(options: Options) -> None:
    """Show the avatar until Ctrl-C, or write the page."""
    from ..viewer import view, view_html

    if options.html is not None:
        check_file(options.html)
    avatar = read_avatar(options.avatar, options.body, options.template)
    motion = None
    if options.motion is not None:
        motion = read_stretch(options.motion, options, avatar.body)
    if options.html is not None:
        view_html(options.html, avatar, motion, title=options.avatar.stem)
        written(options.html, "a page that plays alone", quiet=options.quiet)
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
