"""Draw the figures of conventions: axes, joints, parts, poses, hands, skinning weights.

python docs/pictures/conventions.py
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import xavatar_jax as xa
from xavatar_jax.body import rest_joints
from xavatar_jax.render import (
    Camera,
    draw_text,
    frame_view,
    grid_picture,
    part_view,
    render_mesh,
    save_png,
)

FOLDER = Path(__file__).resolve().parent
SKIN = (214, 200, 188)
RED, GREEN, BLUE = (200, 60, 50), (60, 150, 70), (50, 90, 180)
PART_COLORS = np.array(
    [(190, 186, 180), (226, 160, 70), (70, 140, 190), (90, 170, 110), (190, 80, 90)], np.uint8
)


def body_mesh(body: xa.BodyModel, params: xa.BodyParams, colors: np.ndarray | None) -> xa.Mesh:
    """The posed body, in its own colours by default."""
    vertices = np.asarray(xa.pose_body(body, params).vertices, np.float32)
    mesh = xa.Mesh(vertices, np.asarray(body.faces)).compute_normals()
    return replace(mesh, colors=np.asarray(body.colors) if colors is None else colors)


def rod(start: np.ndarray, end: np.ndarray, radius: float, color: tuple, *, tip: bool) -> xa.Mesh:
    """A rod between two points, with an arrow tip if `tip`."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    across /= np.linalg.norm(across)
    sides, head = 24, 3.5 * radius if tip else 0.0
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.cross(along, across)
    # Light is computed at vertices, and the end vertices may lie inside another mesh.
    stations = np.linspace(0, length - head, 24)
    profile = [(1e-6, 0.0), *((radius, float(h)) for h in stations)]
    profile += [(2 * radius, length - head)] if tip else []
    profile += [(1e-6, length)]
    # Segments do not share vertices, so that edges stay sharp.
    pieces = []
    for (r0, h0), (r1, h1) in pairwise(profile):
        vertices = np.concatenate([start + h * along + r * ring for r, h in ((r0, h0), (r1, h1))])
        k, after = np.arange(sides), np.roll(np.arange(sides), -1)
        lower = np.stack([k, after, after + sides], axis=1)
        upper = np.stack([k, after + sides, k + sides], axis=1)
        pieces.append(plain(vertices, np.concatenate([lower, upper]), color))
    return joined(pieces)


def ball(centre: np.ndarray, radius: float, color: tuple) -> xa.Mesh:
    """A sphere."""
    import trimesh

    shape = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return plain(np.asarray(shape.vertices) + centre, np.asarray(shape.faces), color)


def plain(vertices: np.ndarray, faces: np.ndarray, color: tuple) -> xa.Mesh:
    """A mesh in one colour."""
    colors = np.tile(np.array(color, np.uint8), (len(vertices), 1))
    return replace(xa.Mesh(vertices.astype(np.float32), faces).compute_normals(), colors=colors)


def joined(meshes: Iterable[xa.Mesh]) -> xa.Mesh:
    """Concatenate meshes."""
    meshes = list(meshes)
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return xa.Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + k for m, k in zip(meshes, starts, strict=True)]),
        np.concatenate([np.asarray(m.normals) for m in meshes]),
        np.concatenate([np.asarray(m.colors) for m in meshes]),
    )


def labelled(
    picture: np.ndarray, camera: Camera, labels: dict[str, np.ndarray], size: int, shift=(12, -9)
) -> np.ndarray:
    """Draw labels next to points in world coordinates."""
    height, width = picture.shape[:2]
    for text, point in labels.items():
        u, v, _ = camera.project(np.asarray(point)[None], width, height)[0]
        picture = draw_text(picture, text, (int(u + shift[0]), int(v + shift[1])), size)
    return picture


def axes(body: xa.BodyModel) -> np.ndarray:
    """The body at rest with the world axes at its feet."""
    rest = body_mesh(body, xa.BodyParams.zeros(body), None)
    origin = np.array([0.0, rest.vertices[:, 1].min(), 0.0])
    lengths = {"x, the person's left": 0.75, "y, up": 2.05, "z, where the person looks": 0.75}
    ends = {
        name: origin + length * np.eye(3)[k] for k, (name, length) in enumerate(lengths.items())
    }
    arrows = [
        rod(origin, end, 0.012, color, tip=True)
        for end, color in zip(ends.values(), (RED, GREEN, BLUE), strict=True)
    ]
    mesh = joined([rest, *arrows])
    reach = np.concatenate([mesh.vertices, [origin + np.array([0.95, 0, 0.3])]])
    camera = frame_view(reach, "three_quarter", aspect=1.0, elevation=0.35)
    return labelled(render_mesh(mesh, camera, 640, ground=True), camera, ends, 17)


def skeleton(body: xa.BodyModel, joints: list[int], thick: float) -> xa.Mesh:
    """Spheres at joints and rods to their parents."""
    places = np.asarray(rest_joints(body, jnp.zeros(0)))
    parts = [ball(places[j], 1.7 * thick, RED) for j in joints]
    for j in joints:
        parent = body.tree.parents[j]
        if parent in joints:
            parts.append(rod(places[parent], places[j], thick, SKIN, tip=False))
    return joined(parts)


def joint_pictures(body: xa.BodyModel) -> np.ndarray:
    """Joint numbers: the body from the front, the head from the left, the left hand."""
    tree, places = body.tree, np.asarray(rest_joints(body, jnp.zeros(0)))
    trunk = list(range(22))
    head = tree.indices("spine3", "neck", "left_collar", "head", "jaw", "left_eye", "right_eye")
    hand = [tree.index("left_wrist"), *range(25, 40)]
    views = [
        (trunk, 0.011, frame_view(places[trunk], "front", margin=1.12, elevation=0.0)),
        (list(head), 0.005, part_view(places[list(head)], (1.0, 0.0, 0.5), margin=1.3)),
        (hand, 0.0022, part_view(places[hand], (0.0, 1.0, 0.05), margin=1.2)),
    ]
    pictures = []
    for joints, thick, camera in views:
        picture = render_mesh(skeleton(body, joints, thick), camera, 520)
        names = {str(j): places[j] for j in joints}
        pictures.append(labelled(picture, camera, names, 14, shift=(8, -25)))
    labels = ["body, from the front", "head, from the left", "left hand, from above"]
    return grid_picture([pictures], column_labels=labels)


def parts(body: xa.BodyModel) -> np.ndarray:
    """Part labels in colour."""
    labels = np.asarray(body.part_labels)
    mesh = body_mesh(body, xa.BodyParams.zeros(body), PART_COLORS[labels])
    hand, face = (mesh.vertices[body.parts.mask(p)] for p in ("left_hand", "face"))
    cameras = (
        frame_view(mesh.vertices, "front"),
        part_view(face, (0.35, 0.05, 1.0), margin=1.35),
        part_view(hand, (0.2, 1.0, 0.5)),
    )
    return grid_picture([[render_mesh(mesh, camera, 420) for camera in cameras]])


def poses(body: xa.BodyModel) -> np.ndarray:
    """Rest pose, canonical pose, and the left hand flat and mean."""
    flat = xa.BodyParams.zeros(body)
    mean = xa.BodyParams.create(body, pose=body.hand_mean)
    meshes = [body_mesh(body, p, None) for p in (flat, xa.canonical_params(body))]
    camera = frame_view(np.concatenate([m.vertices for m in meshes]), "front")
    row = [render_mesh(mesh, camera, 380) for mesh in meshes]
    hand = body.parts.mask("left_hand")
    for params in (flat, mean):
        mesh = body_mesh(body, params, None)
        camera = part_view(mesh.vertices[hand], (0.3, 0.8, 0.9), margin=1.2)
        row.append(render_mesh(mesh, camera, 380))
    names = ["rest pose: all zero", "canonical pose", "zero: the flat hand", "the mean hand"]
    return grid_picture([row], column_labels=names)


def weights(body: xa.BodyModel) -> np.ndarray:
    """A posed body and its skinning weights as a mixture of one colour per bone."""
    frames = xa.synthetic_capture(body=body).test.sequences["signs_and_piano"]
    params = frames[len(frames) // 3].params
    palette = np.random.default_rng(4).uniform(40, 255, (body.num_joints, 3))
    mixture = np.round(np.asarray(body.weights) @ palette).astype(np.uint8)
    meshes = [body_mesh(body, params, colors) for colors in (None, mixture)]
    camera = frame_view(meshes[0].vertices, "three_quarter", aspect=0.75)
    return grid_picture([[render_mesh(mesh, camera, (420, 560), ground=True) for mesh in meshes]])


def main() -> None:
    body = xa.synthetic_body()
    for name, draw in (
        ("axes", axes),
        ("joints", joint_pictures),
        ("parts", parts),
        ("poses", poses),
        ("weights", weights),
    ):
        save_png(FOLDER / f"{name}.png", draw(body))
        print(f"written: {name}.png")


if __name__ == "__main__":
    main()
