"""What a file holds, in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .inputs import read_motion
from .options import Reading

if TYPE_CHECKING:
    from ..body import BodyModel

_NPZ_HEAD = b"PK\x03\x04"


def describe_file(file: Path, reading: Reading, body: BodyModel | None) -> dict[str, Any]:
    """Facts about an avatar, a checkpoint, a body model, a mesh or a motion, as plain values.

    Raises:
        FileNotFoundError: there is nothing at `file`.
        ValueError: it is none of these, damaged, or from a newer version.
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
    """Facts of a file that this library has written with a header; None if it has not."""
    from ..files import load_arrays, load_npz
    from ..files.trees import HEADER

    if not file.is_file() or _head(file) != _NPZ_HEAD or not load_npz(file, only=HEADER):
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
    from ..avatar.store import check_header

    check_header(file, header)
    body = header["body"]
    there = "" if Path(body["path"]).exists() else " (not there)"
    return {
        "written by": f"xavatar_jax {header['version']}",
        "steps": header["steps"],
        **_config(header["config"]),
        "body": {
            "kind": f"{body['kind']}, {body['gender']}",
            "path": f"{body['path']}{there}",
            "checksum": body["checksum"],
            "coefficients": f"{body['num_betas']} shape, {body['num_expression']} expression",
        },
    }


def _checkpoint(file: Path, header: Mapping[str, Any]) -> dict[str, Any]:
    from ..training.checkpoint import check_header

    check_header(file, header)
    config, history = header["run"]["config"], header["history"]
    validation = history.get("validation") or [None]
    return {
        "written by": f"xavatar_jax {header['versions']['xavatar_jax']}",
        "steps": f"{header['step']} of {config['steps']}",
        "best step": header["best"].get("step"),
        "validation": validation[-1],
        "stopped": history.get("stopped") or None,
        **_config(config),
        "body": {"checksum": header["run"]["body"]},
        "device": header["versions"].get("device"),
    }


def _config(config: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "preset": f"{config['preset']}, seed {config['seed']}",
        "skinning": config["skinning"]["kind"],
        "geometry": config["geometry"]["kind"],
    }


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

    from ..body import PARTS

    body = xa.load_body(file)
    labels = list(body.part_labels)
    return {
        "kind": f"body model, {body.kind}, {body.source.gender}",
        "vertices": body.num_vertices,
        "faces": len(body.faces),
        "joints": body.num_joints,
        "coefficients": f"{body.num_betas} shape, {body.num_expression} expression",
        "vertices by part": {name: labels.count(k) for k, name in enumerate(PARTS)},
        "checksum": body.source.checksum,
    }


def _motion(file: Path, reading: Reading, body: BodyModel | None) -> dict[str, Any]:
    motion = read_motion(file, reading, body)
    return {
        "kind": "motion",
        "source": motion.source,
        "frames": len(motion),
        "frames a second": motion.fps,
        "seconds": round(motion.seconds, 3),
        "up": motion.up,
        "joints": len(motion.joint_names),
        "moving": sum(bool(motion.joint(name).any()) for name in motion.joint_names),
        "coefficients": f"{len(motion.betas)} shape, {_width(motion.expression)} expression",
        "model": motion.model,
        "gender": motion.gender,
    }


def _width(expression: Any) -> int:
    return 0 if expression is None else expression.shape[-1]


def _head(file: Path) -> bytes:
    with open(file, "rb") as opened:
        return opened.read(4)
