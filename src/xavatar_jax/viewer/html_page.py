"""One self-contained page: the rig, its motion and a small player, in a single HTML file."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..avatar import (
    Animation,
    Drivable,
    MotionLike,
    animate,
    build_clip,
    build_rig,
    expression_scales,
    spread_frames,
)
from ..body import BodyParams, facing
from ..export import Clip, Rig, limit_influences, rotation_quaternions
from ..files import atomic_path
from ..kinematics import TO_Y_UP
from ..render import SKIN_COLOR, WEIGHT_RAMP, bone_palette
from .surfaces import UpAxis, rest_params

_INFLUENCES = 8
# Displacements by blend shapes below this are dropped, metres.
_SMALLEST_MOVE = 2e-5
_FOV = 0.5
_SCRIPTS = ("rig.js", "gl.js", "scene.js", "panel.js")


@dataclass(frozen=True)
class HtmlPage:
    """A page with an avatar; notebooks display it inline.

    - `text`: the HTML.
    - `path`: the file written, if any.
    """

    text: str
    path: Path | None = None

    def _repr_html_(self) -> str:
        inside = html.escape(self.text, quote=True)
        return (
            f'<iframe srcdoc="{inside}" style="width: 100%; height: 600px; border: 0" '
            "allowfullscreen></iframe>"
        )

    def __repr__(self) -> str:
        where = "" if self.path is None else f"{self.path}, "
        return f"HtmlPage({where}{len(self.text) / 1e6:.1f} MB)"


def view_html(
    path: str | os.PathLike[str] | None,
    avatar: Drivable,
    motion: MotionLike | BodyParams | None = None,
    *,
    title: str = "avatar",
    up: Literal["y", "z"] | None = None,
) -> HtmlPage:
    """Write one HTML file that plays the avatar in any browser, without server or network.

    The page contains the rig that `Avatar.export_glb` writes, with eight bones per vertex, and
    moves it on the graphics card (WebGL 2). It has a player and sliders for joints and expression,
    and shows normals and skinning weights. It does not contain what a rig cannot hold:
    pose-dependent offsets and ground truth. Without a motion the avatar is shown at rest.

    Args:
        path: file to write, or None to only display the page in a notebook.
        avatar: the avatar to show.
        motion: a motion, or parameters `(T, ...)` at 30 frames per second.
        title: shown in the page.
        up: the world axis that points up. Default: that of the motion; y for parameters.

    Raises:
        ValueError: if the name does not end in `.html` or `.htm`, or as for `Avatar.animate`.
        OSError: if the file cannot be written; an existing file stays unchanged.
    """
    if path is None:
        return HtmlPage(page_text(avatar, motion, title=title, up=up))
    if not os.fspath(path).lower().endswith((".html", ".htm")):
        raise ValueError(f"{os.fspath(path)}: the page is HTML; use a name that ends in .html")
    with atomic_path(path) as temporary:  # first: an unwritable path fails at once
        text = page_text(avatar, motion, title=title, up=up)
        temporary.write_text(text, encoding="utf-8")
    return HtmlPage(text, Path(path))


def page_text(
    avatar: Drivable,
    motion: MotionLike | BodyParams | None = None,
    *,
    title: str = "avatar",
    up: UpAxis | None = None,
) -> str:
    """The page as text: see `view_html`."""
    animation = animate(avatar, rest_params(avatar) if motion is None else motion)
    axis = up or getattr(motion, "up", "y")
    scales = expression_scales(avatar, [animation])
    rig = build_rig(avatar, scales)
    clip = build_clip("motion", animation, rig, scales, axis)
    manifest, blob = pack(rig, clip, np.zeros(0) if scales is None else scales)
    manifest |= _staging(animation, axis)
    manifest["about"] = _about(rig, clip)
    return fill_template(manifest, blob, title)


def pack(rig: Rig, clip: Clip, scales: Float[np.ndarray, " E"]) -> tuple[dict[str, Any], bytes]:
    """Pack the rig and its clip as named arrays: a manifest and their concatenated bytes."""
    mesh = rig.mesh
    low = mesh.vertices.min(axis=0).astype(np.float64)
    step = float((mesh.vertices - low).max() / 65535) or 1.0
    few = limit_influences(rig.weights, _INFLUENCES)
    small = "|u1" if rig.tree.num_joints <= 256 else "<u2"
    arrays = {
        "positions": np.round((mesh.vertices - low) / step).astype("<u2"),
        "faces": mesh.faces.astype("<u2" if mesh.num_vertices < 2**16 else "<u4"),
        "joints": few.joints.astype(small),
        "weights": np.round(65535 * few.weights).astype("<u2"),
        "inverse_bind": np.linalg.inv(rig.bind)[:, :3].astype("<f4"),
        "rotations": rotation_quaternions(clip.rotations).astype("<f4"),
        "translations": clip.translations.astype("<f4"),
        "coefficients": clip.coefficients.astype("<f4"),
        "palette": bone_palette(rig.tree.num_joints),
        "ramp": WEIGHT_RAMP,
        **_sparse_targets(rig.targets),
    }
    if mesh.colors is not None:
        arrays["colors"] = np.ascontiguousarray(mesh.colors[:, :3])
    table, blob = {}, bytearray()
    for name, array in arrays.items():
        blob += b"\0" * (-len(blob) % 4)
        kind = array.dtype.str
        table[name] = {"dtype": kind, "shape": list(array.shape), "offset": len(blob)}
        blob += np.ascontiguousarray(array).tobytes()
    manifest = {
        "arrays": table,
        "names": list(rig.tree.names),
        "parents": list(rig.tree.parents),
        "target_names": list(rig.target_names),
        "expression_scales": scales.tolist(),
        "low": low.tolist(),
        "step": step,
        "fps": clip.fps,
        "frames": len(clip),
        "color": list(SKIN_COLOR),
    }
    return manifest, bytes(blob)


def _sparse_targets(targets: Float[np.ndarray, "E V 3"]) -> dict[str, np.ndarray]:
    """Blend shapes as the vertices they move and 16-bit steps, since most vertices stay."""
    moved = [np.flatnonzero(np.abs(shape).max(axis=1) > _SMALLEST_MOVE) for shape in targets]
    steps = [
        max(float(np.abs(shape[own]).max(initial=0.0)) / 32767, 1e-12)
        for shape, own in zip(targets, moved, strict=True)
    ]
    moves = [
        np.round(shape[own] / step) for shape, own, step in zip(targets, moved, steps, strict=True)
    ]
    return {
        "target_starts": np.concatenate([[0], np.cumsum([len(own) for own in moved])]).astype(
            "<u4"
        ),
        "target_vertices": np.concatenate([*moved, np.zeros(0)]).astype("<u4"),
        "target_moves": np.concatenate([*moves, np.zeros((0, 3))]).astype("<i2"),
        "target_steps": np.asarray(steps, dtype="<f4"),
    }


def _staging(animation: Animation, up: str) -> dict[str, Any]:
    """Height of the ground, what to frame at the start, and the direction of the light."""
    turn = TO_Y_UP[up]
    first = animation.frame_vertices(0) @ turn.T
    lowest = [
        float((animation.frame_vertices(int(k)) @ turn.T)[:, 1].min())
        for k in spread_frames(len(animation), 6)
    ]
    ahead = turn @ facing(animation.params[0], up)
    yaw = float(np.arctan2(ahead[0], ahead[2]))
    # The light is in front of the person and to the left of the camera.
    angle = yaw - 0.6
    height = float(np.ptp(first[:, 1]))
    return {
        "ground": min(lowest),
        "height": max(height, 0.3),
        "bounds": [*first.min(axis=0).tolist(), *first.max(axis=0).tolist()],
        "yaw": yaw + 0.25,
        "sun": [0.75 * np.sin(angle), 1.25, 0.75 * np.cos(angle)],
        "fov": _FOV,
    }


def _about(rig: Rig, clip: Clip) -> str:
    """One line for the header of the page."""
    text = f"{rig.mesh.num_vertices:,} vertices · {rig.tree.num_joints} joints"
    if len(clip) > 1:
        text += f" · {len(clip)} frames at {clip.fps:g}/s"
    return text


def fill_template(manifest: dict[str, Any], blob: bytes, title: str) -> str:
    """Insert style, scripts and data into the page."""
    folder = Path(__file__).parent / "web"

    def read(name: str) -> str:
        return (folder / name).read_text(encoding="utf-8")

    described = json.dumps(manifest, separators=(",", ":"), allow_nan=False)
    parts = {
        "title": html.escape(title),
        "style": read("style.css"),
        # Inside a script element "</" and "<!--" would be read as markup.
        "manifest": described.replace("<", "\\u003c"),
        "data": base64.b64encode(zlib.compress(blob, 9)).decode("ascii"),
        "script": "\n".join(read(name) for name in _SCRIPTS),
    }
    # In one pass, so that inserted text is not searched again.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], read("page.html"))
