"""Option types and option groups shared by the commands; parsing."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

T = TypeVar("T")

# An empty hint hides "(default: None)" and "(default: False)" in help pages.
Flag = Annotated[bool, arg(help_behavior_hint="")]
Count = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
Number = Annotated[float | None, arg(metavar="X", help_behavior_hint="")]
Seconds = Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")]
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
Folder = Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")]
Word = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Words = Annotated[tuple[str, ...], arg(metavar="NAME ...", help_behavior_hint="")]
OptionalPath = Annotated[Path | None, Positional, arg(help_behavior_hint="")]
OptionalPaths = Annotated[tuple[Path, ...], Positional, arg(help_behavior_hint="")]
Target = Annotated[Path, arg(metavar="PATH")]
Up = Annotated[Literal["y", "z"] | None, arg(metavar="{y,z}", help_behavior_hint="")]
Gender = Annotated[
    Literal["neutral", "female", "male"] | None,
    arg(metavar="{neutral,female,male}", help_behavior_hint=""),
]
Truth = Annotated[bool | None, arg(metavar="{True,False}", help_behavior_hint="")]


@dataclass(kw_only=True)
class Reading:
    """How to read MOTION, where the file leaves it open."""

    read_as: Word = None
    """Format of MOTION, if the file could be of several: see docs/motion.md."""
    file_fps: Number = None
    """Frames per second of MOTION, if the file lacks them or is wrong."""
    file_up: Up = None
    """Up axis of MOTION, if it is not that of its format."""
    person: Count = None
    """Number of the person, in a file with several."""
    flat_hand_mean: Truth = None
    """Hand poses of MOTION. True: absolute; False: relative to the mean hand."""
    joint_map: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """BVH: JSON file that maps its joint names to those of SMPL-X, or smplx, smpl, mixamo, cmu."""
    scale: Number = None
    """BVH: metres per unit (default: from the length of the legs)."""


@dataclass(kw_only=True)
class Driven:
    """Options of the commands in which an avatar follows a motion; see `files.read_driven`."""

    fps: Number = None
    """Frames per second (default: those of the motion)."""
    start: Seconds = None
    """Start of the part of MOTION that is used."""
    end: Seconds = None
    """End of the part of MOTION that is used."""
    body: File = None
    """Body model, if it is not where the avatar was trained ("bundled": the bundled body)."""
    template: File = None
    """Template mesh of the person, if the avatar was trained on one."""
    quiet: Flag = False
    """No progress bars, no report."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


@dataclass(kw_only=True)
class Data:
    """Capture with training and held-out frames."""

    data: Folder = None
    """Folder of the capture (default: the bundled one)."""
    test: Words = ()
    """Sequences to hold out, if the capture has no train and test folders."""
    flat_hand_mean: Truth = None
    """Hand poses of meshes with parameters. True: absolute; False: relative to the mean hand."""
    eval_frames: Annotated[str, arg(metavar="N|all")] = "24"
    """Number of held-out frames to evaluate, spread over the sequences."""
    gender: Gender = None
    """Gender of the body, instead of the one that the data name."""


def parse(
    options: type[T], arguments: Sequence[str], prog: str, description: str | None = None
) -> T:
    """Parse a command line. Prints help or an error and exits with 0 or 2 where that applies."""
    return tyro.cli(
        options,
        prog=prog,
        description=inspect.cleandoc(description or options.__doc__ or ""),
        args=list(arguments),
        config=(
            tyro.conf.PositionalMetavarFromFieldName,
            tyro.conf.FlagCreatePairsOff,
            tyro.conf.AvoidSubcommands,
        ),
    )


def option_names(options: type) -> dict[str, str]:
    """Options of a command line by field name, without positional arguments."""
    found: dict[str, str] = {}
    hints = get_type_hints(options, include_extras=True)
    for entry in fields(options):
        kind = hints[entry.name]
        inner = kind.__origin__ if hasattr(kind, "__metadata__") else kind
        marks = {repr(mark) for mark in getattr(kind, "__metadata__", ())}
        if isinstance(inner, type) and is_dataclass(inner):
            found |= option_names(inner)
        elif not marks & {"Positional", "Suppress"}:
            found[entry.name] = f"--{entry.name.replace('_', '-')}"
    return found


def spoken_names(command: Any) -> dict[str, str]:
    """Options of a subcommand's module by the library's argument names, for messages.

    Arguments of `load_motion` have other names on the command line; `SPOKEN` in the module adds
    more.
    """
    names = option_names(command.Options)
    if "read_as" in names:
        names |= {"format": "--read-as", "fps": "--file-fps", "up": "--file-up"}
    return names | getattr(command, "SPOKEN", {})
