"""Time of rendering and of the viewer for one avatar; draws the images of docs/view-and-render.md.

python benchmarks/view_and_render.py out/fit_grab/avatar.npz
python benchmarks/view_and_render.py out/fit_grab/avatar.npz --pictures docs/pictures
"""

from __future__ import annotations

import argparse
import time
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import print_rows, write_result

import xavatar_jax as xa
from xavatar_jax.geometry import closest_points
from xavatar_jax.render import (
    SKIN_COLOR,
    color_bar,
    error_colors,
    frame_view,
    grid_picture,
    render_mesh,
    save_png,
    turntable,
    weight_colors,
)
from xavatar_jax.report import describe_machine


def clock(work: Callable[[], Any], repeats: int = 5) -> tuple[float, float]:
    """Minimum wall and CPU time of several calls after a warm-up call, seconds."""
    work()
    times = []
    for _ in range(repeats):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    return min(t[0] for t in times), min(t[1] for t in times)


def row(what: str, seconds: float, processor: float | None = None) -> dict[str, Any]:
    return {"what": what, "seconds": seconds, "processor_s": processor}


def picture_rows(mesh: xa.Mesh) -> list[dict[str, Any]]:
    """Images of one mesh, with normals, rays and shadows recomputed for each."""
    bare, rows = replace(mesh, normals=None), []
    for name, size, ground in (
        ("512 x 512", (512, 512), False),
        ("512 x 512 with ground", (512, 512), True),
        ("1920 x 1080 with ground", (1920, 1080), True),
    ):
        camera = frame_view(mesh.vertices, "three_quarter", aspect=size[0] / size[1])
        taken = clock(lambda c=camera, s=size, g=ground: render_mesh(bare, c, s, ground=g))
        rows.append(row(f"image, {name}", *taken))
    wall, processor = clock(lambda: turntable(bare, 8, (1920, 1080)), 2)
    return [*rows, row("turntable, 1920 x 1080, per image of 8", wall / 8, processor / 8)]


def viewer_rows(avatar: xa.Avatar, frames: xa.Frames) -> list[dict[str, Any]]:
    """Time from call to page and to avatar, and from a slider to sending the new mesh."""
    begun = time.perf_counter()
    with xa.view(avatar, frames=frames, verbose=False) as viewer:
        urllib.request.urlopen(viewer.url).read()
        page = time.perf_counter() - begun
        viewer.wait_until_shown()
        shown = time.perf_counter() - begun
        joint = avatar.body.tree.index("left_elbow")

        def slide(degrees: list[float] = [0.0]) -> None:  # noqa: B006
            degrees[0] += 1.0
            viewer.panel.set_turn(joint, (0.0, degrees[0], 0.0))
            request = viewer.panel.request()
            while viewer.shown != request:
                time.sleep(0.001)

        moved = clock(slide, 20)
    return [
        row("viewer, from call to page", page),
        row("viewer, from call to avatar (includes extracting the surface)", shown),
        row("viewer, from slider to sending the moved mesh", *moved),
    ]


def draw(avatar: xa.Avatar, frame: xa.Frame, mesh: xa.Mesh, folder: Path) -> None:
    """Draw one frame in four shadings, and a turntable."""
    camera = frame_view(mesh.vertices, "three_quarter", aspect=0.62)
    distance, _, _ = closest_points(frame.vertices, frame.faces, mesh.vertices)
    weights = weight_colors(np.asarray(avatar.rest.weights).T)
    ways = {
        "color": (mesh, "color"),
        "normal": (mesh, "normal"),
        "weights": (replace(mesh, colors=weights), "error"),
        "error": (replace(mesh, colors=error_colors(1000 * distance, 2.0)), "error"),
    }
    pictures = [
        render_mesh(shown, camera, (310, 500), shading=shading, base_color=SKIN_COLOR, ground=True)
        for shown, shading in ways.values()
    ]
    sheet = grid_picture([[*pictures, color_bar(2.0, (70, 500))]], column_labels=[*ways, ""], gap=4)
    save_png(folder / "shadings.png", sheet)
    save_png(
        folder / "turntable.png",
        grid_picture([turntable(mesh, 6, (210, 420), base_color=SKIN_COLOR)], gap=0),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("avatar", type=Path)
    parser.add_argument("--pictures", type=Path, help="output folder of images")
    parser.add_argument("--no-viewer", action="store_true", help="measure rendering only")
    parser.add_argument("--json", help="JSON file for the results")
    options = parser.parse_args()
    avatar = xa.load_avatar(options.avatar)
    frames = xa.synthetic_capture(body=avatar.body).test.sequences["signs_and_piano"]
    rows = [] if options.no_viewer else viewer_rows(avatar, frames)  # pyright: ignore[reportArgumentType]
    frame = frames[len(frames) // 2]
    mesh = avatar.animate(frame.params)[0].compute_normals()
    if options.pictures is not None:
        draw(avatar, frame, mesh, options.pictures)  # pyright: ignore[reportArgumentType]
    rows = [*picture_rows(mesh), *rows]
    print_rows(rows, ("what", "seconds", "processor_s"))
    header = {
        "question": "seconds of rendering and of the viewer",
        **describe_machine(),
        "vertices": mesh.num_vertices,
    }
    write_result(options.json, header, rows)


if __name__ == "__main__":
    main()
