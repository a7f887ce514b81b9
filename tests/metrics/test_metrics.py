"""Metrics of shapes whose distances and overlaps are known in closed form."""

import json
import math

import numpy as np
import pytest
import trimesh

from xavatar_jax.geometry import winding_number
from xavatar_jax.meshing import Mesh
from xavatar_jax.metrics import mean_metrics, surface_metrics
from xavatar_jax.metrics.compare import box_overlap
from xavatar_jax.metrics.solid import Solid

LABELS = np.array([0, 1, 4, 2, 3])


def from_trimesh(shape) -> Mesh:
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces))


def sphere(radius=0.5, offset=(0.0, 0.0, 0.0), subdivisions=4) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    shape.apply_translation(offset)
    return from_trimesh(shape)


def box(offset=0.0) -> Mesh:
    shape = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    shape.apply_translation((offset, 0.0, 0.0))
    return from_trimesh(shape)


def dumbbell(radius=0.1) -> tuple[Mesh, np.ndarray]:
    """Five spheres on a line, one for each part label; face and eyes_mouth side by side."""
    parts = [sphere(radius, (0.4 * i, 0, 0), 3) for i in range(5)]
    count = parts[0].num_vertices
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + i * count for i, part in enumerate(parts)])
    return Mesh(vertices, faces), np.repeat(LABELS, count)


def quick_metrics(*args, **kwargs):
    names = ("num_samples", "num_volume", "num_near", "num_part_volume")
    sizes = dict.fromkeys(names, 1000)
    return surface_metrics(*args, **sizes, **kwargs)


def test_equal_meshes_are_perfect():
    mesh, labels = dumbbell()
    result = surface_metrics(mesh, mesh, labels=labels)
    for region in ("all", "hands", "face"):
        assert getattr(result.cd_mm, region) == pytest.approx(0, abs=1e-6)
        assert getattr(result.cd_max_mm, region) == pytest.approx(0, abs=1e-4)
        assert getattr(result.nc, region) == pytest.approx(1, abs=2e-3)
        assert getattr(result.iou, region) == 1
        assert getattr(result.iou_near, region) == 1
    assert result.iou_box.all == 1
    assert result.iou_box.hands == pytest.approx(1, abs=0.02)
    assert result.count.all == 20_000
    # Two spheres of five, on both meshes, drawn by area.
    assert result.count.hands == pytest.approx(8_000, rel=0.03)


def test_concentric_spheres():
    inner, outer = sphere(0.5, subdivisions=5), sphere(0.52, subdivisions=5)
    result = surface_metrics(inner, outer)
    assert result.cd_mm.all == pytest.approx(20, abs=0.1)
    assert result.cd_max_mm.all == pytest.approx(20, abs=0.3)
    assert result.nc.all == pytest.approx(1, abs=1e-3)
    assert result.iou.all == pytest.approx((0.5 / 0.52) ** 3, abs=0.005)
    assert result.iou_box.all == pytest.approx((0.5 / 0.52) ** 3, abs=1e-6)


def test_shifted_boxes():
    shift = 0.25
    result = surface_metrics(box(), box(shift))
    expected = (1 - shift) / (1 + shift)
    assert result.iou.all == pytest.approx(expected, abs=0.006)
    assert result.iou_box.all == pytest.approx(expected)
    # Two sides of six are `shift` away; the four long ones are covered but for a strip of width
    # `shift`, whose mean distance to the edge of the other box is half its width.
    assert result.cd_max_mm.all == pytest.approx(250, abs=0.1)


def test_distance_is_point_to_triangle_and_not_squared():
    # Large triangles: a distance between point sets would be tens of millimetres.
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    lifted = Mesh(flat.vertices + np.array([0, 0, 0.01]), flat.faces)
    assert surface_metrics(flat, lifted).cd_mm.all == pytest.approx(10, abs=1e-3)


def test_normal_consistency_ignores_orientation_and_sees_a_right_angle():
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    flipped = Mesh(flat.vertices, flat.faces[:, ::-1])
    assert surface_metrics(flat, flipped).nc.all == pytest.approx(1)
    upright = Mesh(flat.vertices[:, [0, 2, 1]], flat.faces)
    assert surface_metrics(flat, upright).nc.all == pytest.approx(0, abs=1e-12)


def test_distances_are_to_the_other_whole_mesh():
    truth, labels = dumbbell()
    # The left hand is gone: its samples in the truth find the face and the right hand instead.
    gone = truth.keep_faces((labels != 2)[truth.faces[:, 0]])
    result = surface_metrics(gone, truth, labels=labels)
    # From the far side of the missing sphere to the nearest neighbour: over 0.2 m.
    assert result.cd_max_mm.hands > 100
    # No box where the prediction has no sample: the other hand alone remains.
    assert result.iou_box.hands == pytest.approx(1, abs=0.03)


def test_part_overlap_is_local():
    truth, labels = dumbbell(0.1)
    scale = np.where(np.isin(labels, (2, 3)), 0.9, 1.0)[:, None]
    centre = 0.4 * LABELS.argsort()[labels][:, None] * np.array([[1.0, 0, 0]])
    prediction = Mesh((truth.vertices - centre) * scale + centre, truth.faces)
    result = surface_metrics(prediction, truth, labels=labels)
    assert result.iou.hands == pytest.approx(0.9**3, abs=0.01)
    assert result.iou.face == 1
    assert result.cd_mm.hands == pytest.approx(10, abs=0.1)
    assert result.cd_mm.face == pytest.approx(0, abs=1e-6)
    assert result.iou_near.hands < 0.95 < result.iou_near.face


def test_labels_come_from_a_registered_body():
    truth, labels = dumbbell()
    registered = truth.vertices + 0.003
    one = quick_metrics(truth, truth, label_vertices=registered, labels=labels)
    assert one.count.hands == pytest.approx(0.4 * 2 * 1000, rel=0.1)


def test_nothing_measured_is_nan_and_null():
    result = surface_metrics(box(), box(), labels=np.zeros(8, dtype=int))
    for region in ("hands", "face"):
        for figure in ("cd_mm", "cd_max_mm", "nc", "iou", "iou_near", "iou_box"):
            assert math.isnan(getattr(getattr(result, figure), region))
        assert getattr(result.count, region) == 0
    record = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert record["cd_mm"]["hands"] is None
    assert record["count"]["hands"] == 0
    assert record["iou"]["all"] == 1


def test_mean_skips_what_was_not_measured():
    mesh, labels = dumbbell()
    with_hands = quick_metrics(mesh, mesh, labels=labels)
    without = quick_metrics(box(), box(0.25))
    mean = mean_metrics([with_hands, without])
    assert mean.iou.hands == with_hands.iou.hands
    assert mean.iou.all == pytest.approx((with_hands.iou.all + without.iou.all) / 2)
    assert mean.count.hands == with_hands.count.hands
    assert math.isnan(mean_metrics([without]).iou.hands)
    with pytest.raises(ValueError, match="no records"):
        mean_metrics([])


def test_a_seed_gives_the_same_numbers():
    first, again = (quick_metrics(box(), sphere(), seed=3) for _ in range(2))
    assert first.cd_mm.all == again.cd_mm.all
    assert first.iou.all == again.iou.all
    assert quick_metrics(box(), sphere(), seed=4).cd_mm.all != first.cd_mm.all


def test_box_overlap_of_disjoint_and_flat_boxes():
    unit = np.array([[0.0, 0, 0], [1, 1, 1]])
    assert box_overlap(unit, unit + 2) == 0
    flat = unit * [1, 1, 0]
    assert math.isnan(box_overlap(flat, flat))


def test_labels_must_fit():
    with pytest.raises(ValueError, match=r"shape \(8,\), found \(3,\)"):
        surface_metrics(box(), box(), labels=np.zeros(3))
    with pytest.raises(ValueError, match="without labels"):
        surface_metrics(box(), box(), label_vertices=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="2 or more"):
        surface_metrics(box(), box(), num_samples=0)


def test_points_are_inside_where_the_winding_number_says_so(rng):
    """Of shapes that overlap, are nested, or have a hole: one by one against all at once."""
    overlapping = [sphere(0.5), sphere(0.3, (0.5, 0, 0)), sphere(0.2), sphere(0.1, (0, 1.2, 0))]
    counts = np.cumsum([0, *(s.num_vertices for s in overlapping)])
    whole = Mesh(
        np.concatenate([s.vertices for s in overlapping]),
        np.concatenate([s.faces + n for s, n in zip(overlapping, counts, strict=False)]),
    )
    for mesh in (whole, whole.keep_faces(np.arange(whole.num_faces) > 40)):
        points = rng.uniform(-1, 1.5, (20_000, 3))
        expected = winding_number(mesh.vertices, mesh.faces, points) > 0.5
        assert 0.02 < expected.mean() < 0.5
        assert np.array_equal(Solid(mesh).contains(points), expected)
