"""`xavatar convert`: motions between file formats."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional

import xavatar_jax as xa

from .inputs import cut_motion, read_body, read_motion
from .options import READING_NAMES, Count, File, Flag, Gender, Number, Reading, Seconds, Target, arg
from .outputs import check_file, check_new_folder, written

SPOKEN = {**READING_NAMES, "format": "--read-as for MOTION, --format for --out"}


@dataclass
class Options:
    """Write a motion in another file format. The name of --out says which:

      FILE.npz  AMASS, which Blender's SMPL-X add-on takes; z up
      FILE.bvh  BVH; y up
      FILE.npy  pose vectors of X-Avatar's code; y up
      FOLDER    a pose pickle a frame, as of X-Humans; y up
      FILE.pkl  one pose pickle, of --frame; y up

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of ours.

    What a format cannot hold is said.
    """

    motion: Positional[Path]
    """What to read."""
    out: Target = field(kw_only=True)
    """File or folder to write: see above."""
    format: Annotated[
        Literal["amass", "bvh", "poses", "xavatar"] | None,
        arg(metavar="{amass,bvh,poses,xavatar}", help_behavior_hint=""),
    ] = None
    """Format to write, whatever the name of --out."""
    body: File = None
    """The body that moves ("bundled": our own). All but AMASS to AMASS need it."""
    gender: Gender = None
    """Of the body, where --body is a folder of models."""
    fps: Number = None
    """Frames a second afterwards."""
    start: Seconds = None
    """Leave out what is before."""
    end: Seconds = None
    """Leave out what is after."""
    frame: Count = None
    """Only this frame, from 0."""
    smooth: Seconds = None
    """Take out jitter faster than about this."""
    quiet: Flag = False
    """Say nothing but errors and notices."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options) -> None:
    """Read, change, write."""
    is_folder = options.out.suffix == "" and options.format in (None, "poses")
    (check_new_folder if is_folder else check_file)(options.out)
    body = None if options.body is None else read_body(options.body, options.gender)
    motion = read_motion(options.motion, options.reading, body)
    if options.smooth is not None:
        motion = motion.smooth(options.smooth)
    motion = cut_motion(motion, options.start, options.end, options.fps)
    if options.frame is not None:
        if not 0 <= options.frame < len(motion):
            raise ValueError(
                f"--frame {options.frame}: {motion.source} has frames 0 to {len(motion) - 1}"
            )
        motion = motion[options.frame : options.frame + 1]
    xa.save_motion(options.out, motion, format=options.format, body=body)
    frames = "1 frame" if len(motion) == 1 else f"{len(motion)} frames"
    written(options.out, f"{frames}, {motion.fps:g} a second", quiet=options.quiet)
