"""`xavatar info`: this machine, or the contents of a file."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import OmitArgPrefixes

from .._version import __version__
from .files import read_body, read_motion
from .options import File, Flag, OptionalPath, Reading

if TYPE_CHECKING:
    from ..body import BodyModel

_THREADS = ("OMP_NUM_THREADS", "XLA_FLAGS", "JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES")


@dataclass
class Options:
    """Show devices, versions, threads and caches, or the contents of FILE.

    FILE is an avatar, a checkpoint, a body model, a motion (file or folder) or a mesh.
    """

    file: OptionalPath = None
    """File to describe (default: this machine)."""
    body: File = None
    """Body of a motion, for formats that need one ("bundled": the bundled body)."""
    json: Flag = False
    """Print JSON, for scripts and bug reports."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options) -> None:
    """Print the facts, one per line."""
    if options.file is None:
        facts = machine_facts()
    else:
        body = None if options.body is None else read_body(options.body)
        facts = describe_file(options.file, options.reading, body)
    print(json.dumps(facts, indent=2) if options.json else "\n".join(as_lines(facts)))


def machine_facts() -> dict[str, Any]:
    """Devices, versions, threads and caches, and advice if a GPU is not used."""
    import jax

    from ..files import cache_path
    from ..report import available_cores, describe_machine, gpu_advice

    machine = describe_machine()
    settings: Any = jax.config
    devices = jax.devices()
    facts: dict[str, Any] = {
        "xavatar_jax": __version__,
        "devices": [f"{d.platform}: {d.device_kind}" for d in devices],
    }
    advice = gpu_advice({d.platform for d in devices})
    if advice is not None:
        facts["GPU"] = advice
    facts |= {
        "cores": f"{machine['cores']}, {available_cores()} available to this process",
        "environment": {name: os.environ[name] for name in _THREADS if name in os.environ},
        "float64": settings.jax_enable_x64,
        "platform": machine["platform"],
        "commit": machine["commit"],
        "versions": {k: v for k, v in machine["versions"].items() if k != "xavatar-jax"},
        "cache": _folder(cache_path()),
    }
    compiled = settings.jax_compilation_cache_dir
    facts["cache of compiled programs"] = _folder(Path(compiled)) if compiled else None
    facts["SMPLX_MODEL_DIR"] = os.environ.get("SMPLX_MODEL_DIR")
    return facts


def as_lines(facts: dict[str, Any], indent: str = "") -> Iterable[str]:
    """Format facts as one name and value per line, nested ones indented."""
    width = max((len(name) for name in facts), default=0)
    for name, value in facts.items():
        if isinstance(value, dict) and value:
            yield f"{indent}{name}"
            yield from as_lines(value, indent + "  ")
        else:
            yield f"{indent}{name:{width}}  {_shown(value)}"


def _shown(value: Any) -> str:
    if value is None or value == {}:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _folder(folder: Path) -> dict[str, Any]:
    try:
        sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    except OSError as error:
        return {"path": str(folder), "size": f"not readable: {error.strerror}"}
    size = f"{sum(sizes) / 1e6:.1f} MB in {len(sizes)} files"
    return {"path": str(folder), "size": size if folder.is_dir() else "does not exist yet"}


def describe_file(file: Path, reading: Reading, body: BodyModel | None) -> dict[str, Any]:
    """Facts about an avatar, a checkpoint, a body model, a mesh or a motion, as plain values.

    **Raises:** `FileNotFoundError` if there is no such file; `ValueError` if it is none of these,
    damaged, or from a newer version.
    """
    from ..files.meshes import MESH_SUFFIXES

    if not file.is_dir():
        kind = _own_kind(file)
        if kind is not None:
            return kind
        if file.suffix.lower() in MESH_SUFFIXES:
            return _mesh(file)
        if _is_body(file):
            return _body(file)
    return _motion(file, reading, body)


def _own_kind(file: Path) -> dict[str, Any] | None:
    """Facts about a file that this library wrote with a header; None for other files."""
    from ..files import load_arrays, load_npz
    from ..files.trees import HEADER

    if not file.is_file():
        return None
    with open(file, "rb") as opened:
        head = opened.read(4)
    if head != b"PK\x03\x04" or not load_npz(file, only=HEADER):
        return None
    arrays, header = load_arrays(file)
    size = sum(array.nbytes for array in arrays.values())
    held = {"arrays": f"{len(arrays)}, {size / 1e6:.1f} MB"}
    kind = header.get("kind")
    if kind == "avatar":
        return {"kind": "avatar", **_avatar(file, header), **held}
    if kind == "checkpoint":
        return {"kind": "checkpoint", **_checkpoint(file, header), **held}
    return {"kind": kind or "fields fitted to a body's mean shape", **held}


def _avatar(file: Path, header: Mapping[str, Any]) -> dict[str, Any]:
    from ..avatar import load_avatar_header

    known = load_avatar_header(file)
    body = known.body
    there = "" if Path(body["path"]).exists() else " (missing)"
    return {
        "written by": f"xavatar_jax {header['version']}",
        "method": known.method,
        "steps": known.steps,
        "skinning": known.spec.skinning.kind,
        "geometry": known.spec.geometry.kind,
        "body": {
            "kind": f"{body['kind']}, {body['gender']}",
            "path": f"{body['path']}{there}",
            "checksum": body["checksum"],
            "coefficients": f"{body['num_betas']} shape, {body['num_expression']} expression",
        },
    }


def _checkpoint(file: Path, header: Mapping[str, Any]) -> dict[str, Any]:
    from ..learning.checkpoint import check_header

    check_header(file, header)
    run, history = header["run"], header["history"]
    config, parts = run["options"], run["parts"]
    validation = history.get("validation") or [None]
    facts = {
        "written by": f"xavatar_jax {header['versions']['xavatar_jax']}",
        "stage": parts.get("stage"),
        "steps": " of ".join(
            str(n) for n in (header["step"], config.get("steps")) if n is not None
        ),
        "best step": header["best"].get("step"),
        "validation": validation[-1],
        "stopped": history.get("stopped") or None,
        "preset": config.get("preset"),
        "seed": config["seed"],
        **{name: config[name]["kind"] for name in ("skinning", "geometry") if name in config},
        "body": {"checksum": parts["body"]},
        "device": header["versions"].get("device"),
    }
    # Methods differ in their stages and configs.
    return {k: v for k, v in facts.items() if v is not None or k not in ("stage", "preset")}


def _mesh(file: Path) -> dict[str, Any]:
    from ..files.meshes import read_mesh

    vertices, faces = read_mesh(file)
    size = vertices.max(0) - vertices.min(0)
    return {
        "kind": "mesh",
        "vertices": len(vertices),
        "faces": len(faces),
        "size": " x ".join(f"{length:.3f}" for length in size),
    }


def _is_body(file: Path) -> bool:
    from ..motion.format import open_source

    source = open_source(file)
    return source.kind in ("npz", "pickle") and {"v_template", "kintree_table"} <= source.keys


def _body(file: Path) -> dict[str, Any]:
    import xavatar_jax as xa

    body = xa.load_body(file)
    labels = list(body.parts.labels)
    return {
        "kind": f"body model, {body.kind}, {body.source.gender}",
        "vertices": body.num_vertices,
        "faces": len(body.faces),
        "joints": body.num_joints,
        "coefficients": f"{body.num_betas} shape, {body.num_expression} expression",
        "vertices by part": {name: labels.count(k) for k, name in enumerate(body.parts.names)},
        "checksum": body.source.checksum,
    }


def _motion(file: Path, reading: Reading, body: BodyModel | None) -> dict[str, Any]:
    motion = read_motion(file, reading, body)
    expression = 0 if motion.expression is None else motion.expression.shape[-1]
    return {
        "kind": "motion",
        "source": motion.source,
        "frames": len(motion),
        "frames per second": motion.fps,
        "seconds": round(motion.seconds, 3),
        "up": motion.up,
        "joints": len(motion.joint_names),
        "moving": sum(bool(motion.joint(name).any()) for name in motion.joint_names),
        "coefficients": f"{len(motion.betas)} shape, {expression} expression",
        "model": motion.model,
        "gender": motion.gender,
    }
