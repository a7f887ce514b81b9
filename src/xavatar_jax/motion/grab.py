"""Reading motions from GRAB's own archives.

They hold nested dictionaries: `body["params"]` with `fullpose` (all 55 joints, absolute hands),
`transl` and `expression`, and `body["vtemp"]`, the path of the subject's template mesh, which
takes the place of shape coefficients.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..body import SMPLX_TREE
from .record import Motion, UpAxis


def is_grab(data: dict[str, Any]) -> bool:
    """Whether an archive's entries are those of GRAB."""
    return isinstance(data.get("body"), dict) and "params" in data["body"]


def read_grab(data: dict[str, Any], path: Path, *, fps: float | None, up: UpAxis) -> Motion:
    """The motion in the entries of a GRAB archive.

    Raises:
        ValueError: an entry is missing or misshapen.
    """
    params = data["body"]["params"]
    for key in ("fullpose", "transl"):
        if key not in params:
            raise ValueError(
                f"{path}: no {key} in body.params; found {', '.join(sorted(params)) or 'nothing'}."
            )
    if fps is None and "framerate" not in data:
        raise ValueError(f"{path}: no framerate; found {', '.join(sorted(data))}. Give fps=.")
    pose = np.asarray(params["fullpose"], np.float64)
    if pose.ndim != 2 or pose.shape[1] != 3 * SMPLX_TREE.num_joints:
        raise ValueError(f"{path}: fullpose has shape {pose.shape}, expected (T, 165).")
    template = data["body"].get("vtemp")
    return Motion(
        poses=pose.reshape(len(pose), -1, 3),
        transl=np.asarray(params["transl"]),
        joint_names=SMPLX_TREE.names,
        fps=float(np.asarray(data["framerate"]).reshape(-1)[0]) if fps is None else fps,
        expression=np.asarray(params["expression"]) if "expression" in params else None,
        up=up,
        gender=text(data["gender"]).lower() if "gender" in data else "unknown",
        source=str(path),
        template=None if template is None else text(template),
    )


def text(value: Any) -> str:
    """A word stored as a string, as bytes, or as an array of either."""
    item = np.asarray(value).reshape(-1)[0]
    return (item.decode() if isinstance(item, bytes) else str(item)).strip()
