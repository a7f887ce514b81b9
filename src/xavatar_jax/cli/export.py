"""`xavatar export`: an avatar for other programs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

import xavatar_jax as xa

from .files import check_frame, check_output, read_avatar, read_driven, written
from .options import Count, Driven, OptionalPaths, Target

if TYPE_CHECKING:
    from ..body import BodyModel
    from ..motion import Motion


@dataclass
class Options(Driven):
    """Write an avatar for other programs. The format follows from the name of --out:

      FILE.glb            a rigged mesh, expressions as blend shapes, one clip per MOTION
      FILE.ply, FILE.obj  one mesh, in canonical pose or in a frame of MOTION
      FOLDER              one mesh per frame of MOTION, all with the same faces
      FILE.npz            skinning weights, skeleton and mesh as plain arrays

    MOTION: a file or folder, as in docs/motion.md, or "bundled", a motion of the library.
    """

    avatar: Positional[Path]
    """Avatar file written by `xavatar fit`."""
    motion: OptionalPaths = ()
    """Motion to follow; a GLB takes several."""
    out: Target = field(kw_only=True)
    """Output file or folder; see above."""
    influences: Literal[4, 8] = 4
    """GLB: bones per vertex. Blender reads eight, three.js the first four."""
    expressions: Count = None
    """GLB: number of expression coefficients exported as blend shapes (default: all)."""
    format: Literal["ply", "obj"] = "ply"
    """FOLDER: format of the mesh files."""
    frame: Count = None
    """FILE.ply, FILE.obj: number of the frame of MOTION, from 0."""


def run(options: Options) -> None:
    """Write the output that the name of --out asks for."""
    suffix, count = options.out.suffix.lower(), len(options.motion)
    if suffix not in ("", ".glb", ".ply", ".obj", ".npz"):
        raise ValueError(
            f"{options.out}: unknown format {suffix}. Use .glb, .ply, .obj, .npz (skinning "
            "weights) or a folder (one mesh per frame)"
        )
    if suffix == ".npz" and count:
        raise ValueError(
            f"{options.out}: skinning weights do not depend on a motion; leave out MOTION"
        )
    if (suffix in (".ply", ".obj") and count > 1) or (suffix == "" and count != 1):
        raise ValueError(f"{options.out}: this output needs one MOTION, found {count}")
    if options.frame is not None and (suffix not in (".ply", ".obj") or not count):
        raise ValueError("--frame applies to one mesh of a MOTION: --out FILE.ply or FILE.obj")
    check_output(options.out, "file" if suffix else "new folder")
    avatar = read_avatar(options.avatar, options.body, options.template)
    motions = _motions(options, avatar.body)
    if suffix == ".glb":
        avatar.export_glb(
            options.out,
            motions or None,
            influences=options.influences,
            expressions=True if options.expressions is None else options.expressions,
            verbose=not options.quiet,
        )
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
        if not motions:
            mesh, what = avatar.canonical_mesh(), "canonical pose"
        else:
            (motion,) = motions.values()
            frame = check_frame(options.frame or 0, motion)
            mesh, what = avatar.animate(motion)[frame], f"frame {frame} of {motion.source}"
        write = {".ply": xa.write_ply, ".obj": xa.write_obj}[suffix]
        write(options.out, mesh.compute_normals())
        written(options.out, f"{mesh.num_vertices} vertices, {what}", quiet=options.quiet)


def _motions(options: Options, body: BodyModel) -> dict[str, Motion]:
    """Motions, y up, by the names of their clips."""
    found: dict[str, Motion] = {}
    for path in options.motion:
        motion = read_driven(path, options, body)
        stem = Path(motion.source).stem or "motion"
        name, number = stem, 2
        while name in found:
            name, number = f"{stem}_{number}", number + 1
        found[name] = motion
    return found
