"""`xavatar export`: an avatar for other programs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

import xavatar_jax as xa

from .inputs import read_avatar, read_stretch
from .options import (
    READING_NAMES,
    Count,
    Driven,
    OptionalPaths,
    Target,
)
from .outputs import check_file, check_new_folder, written

if TYPE_CHECKING:
    from ..avatar import Avatar
    from ..motion import Motion

SPOKEN = READING_NAMES


@dataclass
class Options(Driven):
    """Write an avatar for other programs. The name of --out says what:

      FILE.glb            a rigged mesh, expressions as blend shapes, each MOTION a clip
      FILE.ply, FILE.obj  one mesh, in canonical pose or in a frame of MOTION
      FOLDER              a mesh for every frame of MOTION, all with the same faces
      FILE.npz            skinning weights, skeleton and mesh as plain arrays

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of ours.
    """

    avatar: Positional[Path]
    """Avatar file, as `xavatar fit` writes it."""
    motion: OptionalPaths = ()
    """What it is to do; several, one after another, for a GLB of several clips."""
    out: Target = field(kw_only=True)
    """File or folder to write: see above."""
    influences: Literal[4, 8] = 4
    """GLB: bones a vertex. Blender reads eight, three.js the first four."""
    expressions: Count = None
    """GLB: coefficients of expression that get blend shapes; without it all."""
    format: Literal["ply", "obj"] = "ply"
    """FOLDER: kind of the mesh files."""
    frame: Count = None
    """FILE.ply, FILE.obj: which frame of MOTION, from 0."""


def run(options: Options) -> None:
    """Write what the name of the output asks for."""
    suffix, count = options.out.suffix.lower(), len(options.motion)
    if suffix not in ("", ".glb", ".ply", ".obj", ".npz"):
        raise ValueError(
            f"{options.out}: nothing is written to {suffix} files. Use .glb, .ply, .obj, .npz "
            "(skinning weights) or a folder (a mesh for every frame)"
        )
    if suffix == ".npz" and count:
        raise ValueError(f"{options.out}: skinning weights depend on no motion; leave out MOTION")
    if (suffix in (".ply", ".obj") and count > 1) or (suffix == "" and count != 1):
        raise ValueError(f"{options.out}: one MOTION is needed for it, {count} are given")
    if options.frame is not None and (suffix not in (".ply", ".obj") or not count):
        raise ValueError("--frame is for one mesh, FILE.ply or FILE.obj, of a MOTION")
    (check_file if suffix else check_new_folder)(options.out)
    avatar = read_avatar(options.avatar, options.body, options.template)
    motions = _motions(options, avatar)
    if suffix == ".glb":
        _write_glb(options, avatar, motions)
    elif suffix == ".npz":
        avatar.export_weights(options.out)
        written(options.out, "skinning weights", quiet=options.quiet)
    elif suffix == "":
        (motion,) = motions.values()
        files = avatar.animate(motion).export_sequence(
            options.out, format=options.format, verbose=not options.quiet
        )
        written(options.out, f"{len(files)} meshes", quiet=options.quiet)
    else:
        _write_mesh(options, avatar, motions)


def _motions(options: Options, avatar: Avatar) -> dict[str, Motion]:
    """Motions by the names that their clips get, y-up."""
    found: dict[str, Motion] = {}
    for path in options.motion:
        motion = read_stretch(path, options, avatar.body)
        stem = Path(motion.source).stem or "motion"
        name, number = stem, 2
        while name in found:
            name, number = f"{stem}_{number}", number + 1
        found[name] = motion
    return found


def _write_glb(options: Options, avatar: Avatar, motions: dict[str, Motion]) -> None:
    avatar.export_glb(
        options.out,
        motions or None,
        influences=options.influences,
        expressions=True if options.expressions is None else options.expressions,
        verbose=not options.quiet,
    )


def _write_mesh(options: Options, avatar: Avatar, motions: dict[str, Motion]) -> None:
    if motions:
        (motion,) = motions.values()
        frame = options.frame or 0
        if not 0 <= frame < len(motion):
            raise ValueError(f"--frame {frame}: {motion.source} has frames 0 to {len(motion) - 1}")
        mesh, told = avatar.animate(motion)[frame], f"frame {frame} of {motion.source}"
    else:
        mesh, told = avatar.canonical_mesh(), "canonical pose"
    write = {".ply": xa.write_ply, ".obj": xa.write_obj}[options.out.suffix.lower()]
    write(options.out, mesh.compute_normals())
    written(options.out, f"{mesh.num_vertices} vertices, {told}", quiet=options.quiet)
