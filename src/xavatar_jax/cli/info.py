"""`xavatar info`: this machine, or what is in a file."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tyro.conf import OmitArgPrefixes

from .._version import __version__
from .describe import describe_file
from .inputs import read_body
from .options import READING_NAMES, File, Flag, OptionalPath, Reading

SPOKEN = READING_NAMES
_THREADS = ("OMP_NUM_THREADS", "XLA_FLAGS", "JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES")


@dataclass
class Options:
    """Show devices, versions, threads and caches; or, with FILE, what is in it.

    FILE is an avatar, a checkpoint, a body model, a motion (file or folder) or a mesh.
    """

    file: OptionalPath = None
    """What to look at."""
    body: File = None
    """The body a motion is for, where it means nothing without one ("bundled": our own)."""
    json: Flag = False
    """As JSON, for scripts and reports of errors."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options) -> None:
    """Print the facts, one a line."""
    if options.file is None:
        facts = machine_facts()
    else:
        body = None if options.body is None else read_body(options.body)
        facts = describe_file(options.file, options.reading, body)
    print(json.dumps(facts, indent=2) if options.json else "\n".join(as_lines(facts)))


def machine_facts() -> dict[str, Any]:
    """Devices, versions, threads and caches, and what to do for a GPU that is not used."""
    import jax

    from ..files import cache_dir
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
        "cores": f"{machine['cores']}, {available_cores()} of them for this process",
        "environment": {name: os.environ[name] for name in _THREADS if name in os.environ},
        "float64": settings.jax_enable_x64,
        "platform": machine["platform"],
        "commit": machine["commit"],
        "versions": {k: v for k, v in machine["versions"].items() if k != "xavatar-jax"},
        "cache": _folder(cache_dir()),
    }
    compiled = settings.jax_compilation_cache_dir
    facts["cache of compiled programs"] = _folder(Path(compiled)) if compiled else None
    models = os.environ.get("SMPLX_MODEL_DIR")
    facts["SMPLX_MODEL_DIR"] = models
    return facts


def as_lines(facts: dict[str, Any], indent: str = "") -> Iterable[str]:
    """Facts for people: a name and a value a line, nested ones indented."""
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
    files = [path for path in folder.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    return {"path": str(folder), "size": f"{size / 1e6:.1f} MB in {len(files)} files"}
