"""Pictures of an avatar beside the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from ..avatar import Animation, Avatar
from ..avatar.animate import spread_frames
from ..body import FACES, LEFT_HAND, RIGHT_HAND, BodyParams, facing
from ..frames import Frame, Frames
from ..geometry import closest_points
from ..meshing import Mesh
from ..render import (
    SKIN_COLOR,
    TRUTH_COLOR,
    Camera,
    color_bar,
    error_colors,
    frame_view,
    grid_picture,
    part_view,
    render_mesh,
)


def preview(
    avatar: Avatar, frame: Frame, *, size: int = 420, max_error_mm: float = 2.0
) -> UInt8[np.ndarray, "H W 3"]:
    """Ground truth, avatar and its distance to the truth: whole body, hands and face."""
    truth = Mesh(frame.vertices, frame.faces).compute_normals()
    mesh = avatar.mesh(frame.params).compute_normals()
    distance, _, _ = closest_points(truth.vertices, truth.faces, mesh.vertices)
    error = replace(mesh, colors=error_colors(1000 * distance, max_error_mm))
    labels = np.asarray(avatar.body.part_labels)
    template = avatar.posed_template(frame.params)
    forward = tuple(facing(frame.params))
    views: list[tuple[str, Camera, float]] = [
        ("body", frame_view(template, "three_quarter", forward=forward, aspect=0.8), 1.25)
    ]
    for name, parts in (
        ("left hand", (LEFT_HAND,)),
        ("right hand", (RIGHT_HAND,)),
        ("face", FACES),
    ):
        own = template[np.isin(labels, parts)]
        if len(own):
            direction = forward if name == "face" else None
            views.append((name, part_view(own, direction, forward=forward), 1.0))
    rows = []
    for _, camera, tall in views:
        shape = (int(size / tall**0.5), int(size * tall**0.5))
        rows.append(
            [
                render_mesh(truth, camera, shape, base_color=TRUTH_COLOR),
                render_mesh(mesh, camera, shape, base_color=SKIN_COLOR),
                render_mesh(error, camera, shape, shading="error"),
            ]
        )
    rows[0].append(color_bar(max_error_mm, (70, rows[0][0].shape[0])))
    return grid_picture(
        rows,
        column_labels=["ground truth", "avatar", "distance (mm)"],
        row_labels=[name for name, _, _ in views],
    )


def animation(
    avatar: Avatar, frames: Frames, *, size: int = 360, count: int = 36
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The avatar beside the truth, `count` frames of one sequence from a fixed camera."""
    chosen = spread_frames(len(frames), count)
    params = frames[chosen].params
    camera = frame_view(_reach(avatar, params), "front", forward=tuple(facing(params[0])))
    pictures = []
    meshes = avatar.animate(params)
    for k, mesh in zip(chosen, meshes, strict=True):
        frame = frames[int(k)]
        truth = Mesh(frame.vertices, frame.faces).compute_normals()
        row = [
            render_mesh(truth, camera, size, base_color=TRUTH_COLOR),
            render_mesh(mesh.compute_normals(), camera, size, base_color=SKIN_COLOR),
        ]
        pictures.append(grid_picture([row], column_labels=["ground truth", "avatar"]))
    return pictures


def motion_pictures(
    animation: Animation,
    *,
    size: int | tuple[int, int] = 512,
    view: str = "front",
    shading: str = "color",
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """A picture of every frame of an animation, from a fixed camera that has all of it in view.

    `size` in pixels, one number or width and height; `view` as for `frame_view`, counted from
    where the person looks in the first frame; `shading` as for `render_mesh`. y is up.
    """
    width, height = (size, size) if isinstance(size, int) else size
    reach = _reach(animation.avatar, animation.params, count=100)
    forward = tuple(facing(animation.params[0]))
    camera = frame_view(reach, view, forward=forward, aspect=width / height)
    floor = float(reach[:, 1].min())
    for mesh in animation:
        yield render_mesh(
            mesh.compute_normals(),
            camera,
            (width, height),
            shading=shading,
            base_color=SKIN_COLOR,
            ground=shading == "color",
            ground_height=floor,
        )


def _reach(avatar: Avatar, params: BodyParams, count: int = 8) -> Float[np.ndarray, "N 3"]:
    """Vertices of the body in frames spread over a motion, which a camera has to show."""
    chosen = spread_frames(len(params), count)
    return np.concatenate([avatar.posed_template(params[int(k)]) for k in chosen])
