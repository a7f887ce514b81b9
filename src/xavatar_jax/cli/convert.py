"""`xavatar convert`: motions between file formats."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional

import xavatar_jax as xa

from .files import check_frame, check_output, cut_motion, read_body, read_motion, written
from .options import Count, File, Flag, Gender, Number, Reading, Seconds, Target, arg

SPOKEN = {"format": "--read-as for MOTION, --format for --out"}


@dataclass
class Options:
    """Convert a motion to another file format, which follows from the name of --out:

      FILE.npz  AMASS, which Blender's SMPL-X add-on imports; z up
      FILE.bvh  BVH; y up
      FILE.npy  pose vectors of X-Avatar's code; y up
      FOLDER    one pose pickle per frame, as in X-Humans; y up
      FILE.pkl  one pose pickle, of --frame; y up

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of the library.

    Losses of the conversion are reported.
    """

    motion: Positional[Path]
    """Motion to read."""
    out: Target = field(kw_only=True)
    """Output file or folder; see above."""
    format: Annotated[
        Literal["amass", "bvh", "poses", "xavatar"] | None,
        arg(metavar="{amass,bvh,poses,xavatar}", help_behavior_hint=""),
    ] = None
    """Output format, regardless of the name of --out."""
    body: File = None
    """Body of the motion ("bundled": the bundled body). Needed except from AMASS to AMASS."""
    gender: Gender = None
    """Gender of the body, if --body is a folder of models."""
    fps: Number = None
    """Frames per second of the output."""
    start: Seconds = None
    """Start of the output within the motion."""
    end: Seconds = None
    """End of the output within the motion."""
    frame: Count = None
    """Number of the only frame to write, from 0."""
    smooth: Seconds = None
    """Time scale of the jitter to remove."""
    quiet: Flag = False
    """Print only errors and notices."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options) -> None:
    """Read, edit and write the motion."""
    is_folder = options.out.suffix == "" and options.format in (None, "poses")
    check_output(options.out, "new folder" if is_folder else "file")
    body = None if options.body is None else read_body(options.body, options.gender)
    motion = read_motion(options.motion, options.reading, body)
    if options.smooth is not None:
        motion = motion.smooth(options.smooth)
    motion = cut_motion(motion, options.start, options.end, options.fps)
    if options.frame is not None:
        frame = check_frame(options.frame, motion)
        motion = motion[frame : frame + 1]
    xa.save_motion(options.out, motion, format=options.format, body=body)
    frames = "1 frame" if len(motion) == 1 else f"{len(motion)} frames"
    written(options.out, f"{frames}, {motion.fps:g} per second", quiet=options.quiet)
