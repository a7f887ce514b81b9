"""Reading motions from GRAB's own archives.

They hold nested dictionaries: `body["params"]` with `fullpose` (all 55 joints, absolute hands),
`transl` and `expression`, and `body["vtemp"]`, the path of the subject's template mesh, which
takes the place of shape coefficients.
"""

from __future__ import annotations

import numpy as np

from ..body import SMPLX_TREE
from .format import Format, ReadOptions, Source
from .record import Motion
from .values import check_radians, text


def _recognise(source: Source) -> bool:
    body = source.data["body"] if "body" in source.keys else None
    return isinstance(body, dict) and isinstance(body.get("params"), dict)


def _read(source: Source, options: ReadOptions) -> Motion:
    data, path, fps = source.data, source.path, options.fps
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
    check_radians(pose.reshape(len(pose), -1, 3), "fullpose", path)
    template = data["body"].get("vtemp")
    return Motion(
        poses=pose.reshape(len(pose), -1, 3),
        transl=np.asarray(params["transl"]),
        joint_names=SMPLX_TREE.names,
        fps=float(np.asarray(data["framerate"]).reshape(-1)[0]) if fps is None else fps,
        expression=np.asarray(params["expression"]) if "expression" in params else None,
        up=options.up or "z",
        gender=text(data["gender"]).lower() if "gender" in data else "unknown",
        source=str(path),
        template=None if template is None else text(template),
        model="smplx",
    )


FORMAT = Format(
    name="grab",
    title="GRAB sequence",
    sought="an .npz with body.params of fullpose and transl",
    recognise=_recognise,
    read=_read,
)
