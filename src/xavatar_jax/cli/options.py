"""What the command lines share: types of options, and how they are read and shown."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

T = TypeVar("T")

# "(default: None)" and "(default: False)" are noise in a help page.
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
    """How MOTION is read, where the file does not say it all."""

    read_as: Word = None
    """Its format, if it could be several: see docs/motion.md."""
    file_fps: Number = None
    """Its frames a second, if the file does not say or is wrong."""
    file_up: Up = None
    """The axis that points up in it, if not that of its format."""
    person: Count = None
    """Which person, of a file with several."""
    flat_hand_mean: Truth = None
    """True: its hands are absolute; False: relative to the mean hand."""
    joint_map: Word = None
    """BVH: whose joint names (smplx, smpl, mixamo, cmu), if they are not recognised."""
    scale: Number = None
    """BVH: metres in one of its units, if not told by the length of the legs."""


@dataclass(kw_only=True)
class Driven:
    """What commands share in which an avatar follows a motion: `inputs.read_stretch` reads it."""

    fps: Number = None
    """Frames a second; without it the motion's own."""
    start: Seconds = None
    """Leave out what is before."""
    end: Seconds = None
    """Leave out what is after."""
    body: File = None
    """The body model, if it is not where the avatar was learned ("bundled": our own)."""
    template: File = None
    """The person's own template mesh, for an avatar that was learned on one."""
    quiet: Flag = False
    """No progress bars, no report."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


# Arguments of `load_motion` that have another name on the command line.
READING_NAMES = {"format": "--read-as", "fps": "--file-fps", "up": "--file-up"}


def parse(
    options: type[T], arguments: Sequence[str], prog: str, description: str | None = None
) -> T:
    """Options from a command line. Prints help or what is wrong, and exits with 0 or 2."""
    return tyro.cli(
        options,
        prog=prog,
        description=inspect.cleandoc(description or options.__doc__ or ""),
        args=list(arguments),
        config=(tyro.conf.PositionalMetavarFromFieldName, tyro.conf.FlagCreatePairsOff),
    )


def option_names(options: type) -> dict[str, str]:
    """Options of a command line by the names of their fields; positional ones are left out."""
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
    """How arguments of the library are called on the command line of a subcommand's module."""
    return {**option_names(command.Options), **getattr(command, "SPOKEN", {})}
