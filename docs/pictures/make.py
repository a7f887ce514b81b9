"""Draw the bundled person for the docs: at rest, posed, a hand, the face.

    python docs/pictures/make.py

`preview.png` in the same folder is written by `examples/fit_grab.py`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import xavatar_jax as xa
from xavatar_jax.render import frame_view, part_view, render_mesh, save_png

FOLDER = Path(__file__).resolve().parent


def posed_mesh(body: xa.BodyModel, params: xa.BodyParams) -> xa.Mesh:
    """The posed body in its own colours."""
    vertices = np.asarray(xa.pose_body(body, params).vertices, np.float32)
    mesh = xa.Mesh(vertices, np.asarray(body.faces)).compute_normals()
    return mesh if body.colors is None else replace(mesh, colors=np.asarray(body.colors))


def main() -> None:
    body = xa.synthetic_body()
    rest = posed_mesh(body, xa.BodyParams.zeros(body))
    frames = xa.synthetic_capture(body=body).test.sequences["signs_and_piano"]
    frame = frames[len(frames) // 2]
    posed = posed_mesh(body, frame.params)
    hand, face = (rest.vertices[body.parts.mask(p)] for p in ("left_hand", "face"))
    pictures = {
        "body_rest": (rest, frame_view(rest.vertices, "front"), True),
        "body_posed": (posed, frame_view(posed.vertices, "three_quarter", aspect=0.75), True),
        "body_hand": (rest, part_view(hand, (0.2, 1.0, 0.5)), False),
        "body_face": (rest, part_view(face, (0.35, 0.05, 1.0), margin=1.35), False),
    }
    for name, (mesh, camera, ground) in pictures.items():
        size = (480, 640) if name == "body_posed" else (640, 640)
        path = FOLDER / f"{name}.png"
        save_png(path, render_mesh(mesh, camera, size, ground=ground))
        print(f"written: {path.name}")


if __name__ == "__main__":
    main()
