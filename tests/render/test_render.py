"""Pictures against projective geometry, and files against an independent reader."""

import math
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from xavatar_jax import render
from xavatar_jax.meshing import Mesh

WHITE = (1.0, 1.0, 1.0)


def sphere(radius=0.5, centre=(0.0, 0.0, 0.0), color=None) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    vertices = np.asarray(shape.vertices) + centre
    colors = None if color is None else np.tile(np.array(color, np.uint8), (len(vertices), 1))
    return Mesh(vertices, np.asarray(shape.faces), colors=colors)


def front_camera(distance=3.0) -> render.Camera:
    return render.Camera.look_at((0, 0, distance), (0, 0, 0), fov=math.radians(30))


def test_camera_follows_opencv():
    camera = front_camera()
    # From +z toward the origin: the world's x is right, its y up, so v falls as y grows.
    u, v, depth = camera.project([[0.1, 0.2, 0.0]], 200, 100)[0]
    focal = 50 / math.tan(math.radians(15))
    assert (u, v, depth) == pytest.approx((100 + focal * 0.1 / 3, 50 - focal * 0.2 / 3, 3))
    assert np.linalg.det(camera.rotation) == pytest.approx(1)


def test_rays_pass_through_the_pixels_they_are_for():
    camera = render.Camera.look_at((1, 2, 3), (0.2, 0.1, 0), fov=0.7)
    rays = camera.rays(30, 20)
    points = camera.position + 2.5 * rays[[3, 11], [7, 25]]
    pixels = camera.project(points, 30, 20)
    np.testing.assert_allclose(pixels, [[7.5, 3.5, 2.5], [25.5, 11.5, 2.5]], atol=1e-4)
    window = camera.rays(60, 40, slice(2, 5), slice(10, 14), supersample=2)
    np.testing.assert_array_equal(window, camera.rays(60, 40)[4:10, 20:28])


def test_silhouette_of_a_sphere():
    picture = render.render_mesh(sphere(), front_camera(), 200, background=None)
    coverage = picture[..., 3].sum() / 255.0
    # A sphere's outline is the cone that touches it.
    slope = 0.5 / math.sqrt(3**2 - 0.5**2)
    focal = 100 / math.tan(math.radians(15))
    assert coverage == pytest.approx(np.pi * (focal * slope) ** 2, rel=5e-3)


def test_normals_in_the_camera_frame():
    picture = render.render_mesh(sphere(), front_camera(), 201, shading="normal", supersample=1)
    np.testing.assert_allclose(picture[100, 100], [128, 128, 255], atol=2)
    assert picture[100, 130, 0] > 160
    assert picture[70, 100, 1] > 160


def test_flat_shading_shows_the_colours_and_the_nearer_mesh_wins():
    near, far = sphere(0.3, (0, 0, 1), (255, 0, 0)), sphere(0.5, (0, 0, 0), (0, 0, 255))
    mesh = Mesh(
        np.concatenate([near.vertices, far.vertices]),
        np.concatenate([near.faces, far.faces + near.num_vertices]),
        colors=np.concatenate([near.colors, far.colors]),
    )
    picture = render.render_mesh(mesh, front_camera(), 101, shading="flat", background=WHITE)
    np.testing.assert_array_equal(picture[50, 50], [255, 0, 0])
    np.testing.assert_array_equal(picture[0, 0], [255, 255, 255])
    assert (picture == [0, 0, 255]).all(axis=-1).any()


def test_light_comes_from_the_upper_left():
    picture = render.render_mesh(sphere(), front_camera(), 120).astype(float).mean(axis=-1)
    assert picture[45, 45] > picture[75, 75] + 20


def test_ground_is_dark_under_the_mesh_only():
    camera = render.frame_view(sphere().vertices, elevation=0.5, margin=2.0)
    lit = render.render_mesh(sphere(), camera, 128, ground=True).astype(int)
    plain = render.render_mesh(sphere(), camera, 128).astype(int)
    darker = (plain - lit).mean(axis=-1)
    assert darker.min() >= -1
    below = camera.project([[0, -0.5, 0.3]], 128, 128)[0].astype(int)
    assert darker[below[1], below[0]] > 25 or lit[below[1], below[0]].mean() < 200
    assert darker[0].max() == 0
    clear = render.render_mesh(sphere(), camera, 128, ground=True, background=None)
    assert clear[0, 0, 3] == 0


@pytest.mark.parametrize("view", ["front", "three_quarter", "left", "back", "right"])
def test_framed_points_fill_the_picture(view):
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [0.9, 1.7, 0.3] + [3, 1, -2]
    camera = render.frame_view(points, view, aspect=0.75, margin=1.0)
    pixels = camera.project(points, 300, 400)
    assert pixels[:, :2].min() > -1
    assert (pixels[:, :2].max(axis=0) < [301, 401]).all()
    filled = (pixels[:, :2].max(axis=0) - pixels[:, :2].min(axis=0)) / [300, 400]
    assert filled.max() > 0.97


def test_the_persons_left_is_on_the_right_of_a_front_view():
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 2, 0]])
    left, right, top = render.frame_view(points, "front").project(points, 100, 100)
    assert left[0] > right[0]
    assert top[1] < left[1]
    behind = render.frame_view(points, "back").project(points, 100, 100)
    assert behind[0, 0] < behind[1, 0]


def test_a_flat_part_is_seen_on_its_broad_side():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [0.1, 0.01, 0.06]
    camera = render.part_view(points)
    assert abs(camera.rotation[2, 1]) > 0.99
    assert camera.position[1] > 0


def test_a_turntable_goes_round_at_one_scale():
    box = trimesh.creation.box((0.8, 1.6, 0.3))
    vertices = np.asarray(box.vertices) + np.array([1, 2, 3])
    mesh = Mesh(vertices, np.asarray(box.faces))
    pictures = render.turntable(mesh, 4, (120, 160), ground=False, background=None, elevation=0.0)
    front, side, back, other = (picture[..., 3] > 127 for picture in pictures)
    np.testing.assert_array_equal(front, back)
    np.testing.assert_array_equal(side, other)
    # Wide in front, narrow from the side; nearer corners make it a little wider than 0.3.
    assert 0.3 / 0.8 < side.sum() / front.sum() < 0.55
    for camera in render.orbit_views(vertices, 5, aspect=0.75):
        pixels = camera.project(vertices, 120, 160)
        assert pixels[:, :2].min() > 0
        assert (pixels[:, :2] < [120, 160]).all()
        assert np.linalg.norm(camera.position - [1, 2, 3]) == pytest.approx(
            np.linalg.norm(render.orbit_views(vertices, 1)[0].position - [1, 2, 3]), rel=0.2
        )
    first = render.orbit_views(vertices, 4)
    # The second view is from the person's left, +x for one who faces +z.
    assert first[1].position[0] > 2
    with pytest.raises(ValueError, match="must be 1 or more"):
        render.turntable(mesh, 0)


def test_pictures_of_a_turntable_are_those_drawn_one_by_one():
    bumpy = trimesh.creation.icosphere(subdivisions=6, radius=0.5)
    vertices = np.asarray(bumpy.vertices)
    vertices = vertices * (1 + 0.15 * np.sin(9 * vertices[:, :1])) * [1.0, 1.0, 0.4]
    mesh = Mesh(vertices, np.asarray(bumpy.faces)).compute_normals()
    cameras = render.orbit_views(vertices, 5)
    for picture, camera in zip(render.turntable(mesh, 5, 90), cameras, strict=True):
        alone = render.render_mesh(mesh, camera, 90, ground=True)
        difference = np.abs(picture.astype(int) - alone)
        # The few rays of each vertex are turned by its number among those asked.
        assert difference.mean() < 0.5
        assert (difference.max(axis=-1) > 12).mean() < 0.002


def test_edges_inside_the_outline_are_smooth():
    left, right = sphere(0.5, color=(255, 0, 0)), sphere(0.5, color=(0, 0, 255))
    colors = np.where(left.vertices[:, :1] * [1, 1, 1] < 0.013, left.colors, right.colors)
    mesh = Mesh(left.vertices, left.faces, colors=colors.astype(np.uint8))
    camera = render.Camera.look_at((0.4, 0.3, 3), (0, 0, 0), fov=math.radians(24))
    fine, plain, many = (
        render.render_mesh(mesh, camera, 90, shading="flat", supersample=k).astype(float)
        for k in (3, 1, 9)
    )
    assert np.abs(fine - many).mean() < 0.35 * np.abs(plain - many).mean()


def test_shadows_do_not_depend_on_how_finely_a_shape_is_cut():
    camera = front_camera()
    coarse, fine = (
        trimesh.creation.icosphere(subdivisions=k, radius=0.5) for k in (4, 6)
    )  # the finer one has so many vertices that only some of them are asked
    assert len(fine.vertices) > 40_000
    pictures = [
        render.render_mesh(Mesh(np.asarray(s.vertices), np.asarray(s.faces)), camera, 150)
        for s in (coarse, fine)
    ]
    inside = (slice(45, 105), slice(45, 105))
    difference = np.abs(pictures[0][inside].astype(int) - pictures[1][inside])
    assert difference.mean() < 3


def test_weight_colors():
    weights = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.25, 0.75]])
    one = render.weight_colors(weights, 0).astype(int)
    np.testing.assert_array_equal(one[[2, 1, 0]], render.WEIGHT_RAMP)
    palette = render.bone_palette(3).astype(float)
    np.testing.assert_allclose(render.weight_colors(weights), weights @ palette, atol=0.51)
    many = render.bone_palette(55).astype(int)
    assert np.abs(np.diff(many, axis=0)).max(axis=1).min() > 40
    with pytest.raises(ValueError, match="no bone 3"):
        render.weight_colors(weights, 3)
    with pytest.raises(ValueError, match=r"shape \(V, J\)"):
        render.weight_colors(weights[0])


def test_error_colors():
    colors = render.error_colors([0.0, 1.0, 2.0, 5.0, np.nan], 2.0).astype(int)
    assert colors[0, 2] > colors[0, 0]
    assert colors[2, 0] > colors[2, 2]
    np.testing.assert_array_equal(colors[2], colors[3])
    np.testing.assert_array_equal(colors[4], 160)
    steps = np.abs(np.diff(render.error_colors(np.linspace(0, 1, 200), 1.0).astype(int), axis=0))
    assert steps.max() < 10
    with pytest.raises(ValueError, match="max_mm must be positive"):
        render.error_colors([1.0], 0.0)


def test_color_bar_reads_upwards():
    bar = render.color_bar(3.0, (70, 300)).astype(int)
    assert bar[45, 10, 0] > bar[45, 10, 2]
    assert bar[255, 10, 2] > bar[255, 10, 0]


def test_grid_keeps_every_picture_whole():
    red, green = np.zeros((2, 40, 30, 3), np.uint8)
    red[..., 0], green[..., 1] = 255, 255
    tall = np.zeros((60, 20, 4), np.uint8)
    tall[..., 2:] = 255
    sheet = render.grid_picture(
        [[red, green], [tall]], column_labels=["one", "two"], row_labels=["a", "b"], title="title"
    )
    for color, count in (((255, 0, 0), 1200), ((0, 255, 0), 1200), ((0, 0, 255), 1200)):
        assert (sheet == color).all(axis=-1).sum() == count
    plain = render.grid_picture([[red]])
    assert (sheet[:50] < 120).any()
    assert not (plain[:3] < 120).any()
    with pytest.raises(ValueError, match="no pictures"):
        render.grid_picture([])


def test_files_are_read_back(tmp_path):
    picture = render.render_mesh(sphere(), front_camera(), (64, 48))
    render.save_png(tmp_path / "p.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "p.png")), picture)
    frames = [np.full((32, 48, 3), level, np.uint8) for level in (0, 120, 250)]
    render.save_webp_animation(frames, tmp_path / "a.webp", fps=10)
    with Image.open(tmp_path / "a.webp") as animation:
        assert animation.n_frames == 3
        assert animation.size == (48, 32)
        animation.seek(1)
        animation.load()
        assert animation.info["duration"] == 100
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.webp", "p.png"]


@pytest.mark.parametrize(("name", "fps"), [("gif", 30), ("gif", 48), ("webp", 30)])
def test_animations_keep_time(tmp_path, name, fps):
    """Formats count in hundredths or thousandths of a second."""
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (8, 8, 3), np.uint8) for _ in range(2 * fps)]
    getattr(render, f"save_{name}_animation")(frames, tmp_path / f"a.{name}", fps=fps)
    with Image.open(tmp_path / f"a.{name}") as animation:
        total = 0
        for k in range(animation.n_frames):
            animation.seek(k)
            animation.load()
            total += animation.info["duration"]
    assert total == pytest.approx(2000, abs=10)


def test_bad_pictures_are_refused_and_leave_no_file(tmp_path):
    with pytest.raises(ValueError, match="uint8"):
        render.save_png(tmp_path / "p.png", np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="at least one frame"):
        render.save_webp_animation([], tmp_path / "a.webp")
    frames = [np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)]
    with pytest.raises(ValueError, match="differ in shape"):
        render.save_webp_animation(frames, tmp_path / "a.webp")
    with pytest.raises(ValueError, match="60 frames a second are more than a GIF can hold: 50"):
        render.save_gif_animation(frames[:1], tmp_path / "a.gif", fps=60)
    with pytest.raises(ValueError, match="no shading 'shiny'"):
        render.render_mesh(sphere(), front_camera(), 8, shading="shiny")
    assert list(tmp_path.iterdir()) == []


def test_importing_loads_no_heavy_library():
    code = (
        "import sys\n"
        "from xavatar_jax import export, geometry, meshing, metrics, render\n"
        "heavy = {'trimesh', 'scipy', 'igl', 'embreex', 'PIL', 'pygltflib', 'viser'}\n"
        "before = set(sys.modules) & heavy\n"
        "print(sorted(before))\n"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = found.stdout.strip()
    # JAX itself loads SciPy.
    assert loaded in ("[]", "['scipy']")
