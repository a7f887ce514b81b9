"""Pictures of an avatar, and of an avatar beside the ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from ..avatar import Animation, Drivable, animate, spread_frames
from ..body import BodyParams, facing
from ..frames import Frame, Frames
from ..geometry import closest_points
from ..meshing import Mesh
from ..render import (
    SKIN_COLOR,
    TRUTH_COLOR,
    color_bar,
    error_colors,
    frame_view,
    grid_picture,
    part_view,
    render_sequence,
    render_views,
)


def preview(
    avatar: Drivable, frame: Frame, *, size: int = 420, max_error_mm: float = 2.0
) -> UInt8[np.ndarray, "H W 3"]:
    """Ground truth, avatar and its distance to the truth: whole body, hands and face."""
    truth = Mesh(frame.vertices, frame.faces).compute_normals()
    mesh = avatar.surface(frame.params).compute_normals()
    distance, _, _ = closest_points(truth.vertices, truth.faces, mesh.vertices)
    error = replace(mesh, colors=error_colors(1000 * distance, max_error_mm))
    template = avatar.posed_template(frame.params)
    forward = tuple(facing(frame.params))
    names: list[str] = ["body"]
    sizes: list[int | tuple[int, int]] = [(int(size / 1.25**0.5), int(size * 1.25**0.5))]
    cameras = [frame_view(template, "three_quarter", forward=forward, aspect=0.8)]
    for name, region, _ in avatar.body.parts.pieces:
        part = template[avatar.body.parts.mask(name)]
        if len(part):
            direction = forward if region == "face" else None
            names.append(name.replace("_", " "))
            sizes.append((size, size))
            cameras.append(part_view(part, direction, forward=forward))
    columns = [
        render_views(truth, cameras, sizes, base_color=TRUTH_COLOR),
        render_views(mesh, cameras, sizes, base_color=SKIN_COLOR),
        render_views(error, cameras, sizes, shading="error"),
    ]
    rows = [list(row) for row in zip(*columns, strict=True)]
    rows[0].append(color_bar(max_error_mm, (70, rows[0][0].shape[0])))
    labels_above = ["ground truth", "avatar", "distance (mm)"]
    return grid_picture(rows, column_labels=labels_above, row_labels=names)


def animation(
    avatar: Drivable, frames: Frames, *, size: int = 360, count: int = 36
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The avatar beside the ground truth: `count` frames of one sequence from a fixed camera."""
    chosen = frames[spread_frames(len(frames), count)]
    camera = frame_view(
        _reach(avatar, chosen.params), "front", forward=tuple(facing(chosen.params[0]))
    )
    truths = (Mesh(frame.vertices, frame.faces).compute_normals() for frame in chosen)
    posed = (mesh.compute_normals() for mesh in animate(avatar, chosen.params))
    pairs = zip(
        render_sequence(truths, camera, size, base_color=TRUTH_COLOR),
        render_sequence(posed, camera, size, base_color=SKIN_COLOR),
        strict=True,
    )
    return [grid_picture([pair], column_labels=["ground truth", "avatar"]) for pair in pairs]


def motion_pictures(
    animation: Animation,
    *,
    size: int | tuple[int, int] = 512,
    view: str = "front",
    shading: str = "color",
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """A picture of every frame of an animation, from a fixed camera that sees all of it.

    `size` in pixels, one number or width and height; `view` as for `frame_view`, relative to where
    the person faces in the first frame; `shading` as for `render_mesh`. y is up.
    """
    width, height = (size, size) if isinstance(size, int) else size
    reach = _reach(animation.avatar, animation.params, count=100)
    forward = tuple(facing(animation.params[0]))
    camera = frame_view(reach, view, forward=forward, aspect=width / height)
    floor = float(reach[:, 1].min())
    yield from render_sequence(
        (mesh.compute_normals() for mesh in animation),
        camera,
        (width, height),
        shading=shading,
        base_color=SKIN_COLOR,
        ground=shading == "color",
        ground_height=floor,
    )


def _reach(avatar: Drivable, params: BodyParams, count: int = 8) -> Float[np.ndarray, "N 3"]:
    """Body vertices in `count` frames spread over a motion: what a camera has to show."""
    chosen = spread_frames(len(params), count)
    return np.concatenate([avatar.posed_template(params[int(k)]) for k in chosen])
