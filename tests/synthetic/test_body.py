"""The bundled body: a valid closed human in the SMPL-X layout."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from xavatar_jax import synthetic
from xavatar_jax.body import load_body
from xavatar_jax.files import CacheNotice
from xavatar_jax.synthetic.body import build as build_module

NAMES = [
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "jaw", "left_eye", "right_eye",
]  # fmt: skip
for _side in ("left", "right"):
    NAMES += [
        f"{_side}_{f}{i}" for f in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)
    ]
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15]
PARENTS += [20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38]
PARENTS += [21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53]


@pytest.fixture(scope="session")
def body_path(tmp_path_factory):
    return synthetic.write_synthetic_body(tmp_path_factory.mktemp("body") / "synthetic.npz")


class Body:
    """Plain arrays of the file, for the checks below."""

    def __init__(self, path):
        with np.load(path, allow_pickle=False) as file:
            self.data = {k: file[k] for k in file.files if k != "joint2num"}
        self.vertices = self.data["v_template"].astype(np.float64)
        self.faces = self.data["f"].astype(np.int64)
        self.weights = self.data["weights"].astype(np.float64)
        self.regressor = self.data["J_regressor"].astype(np.float64)
        self.joints = self.regressor @ self.vertices
        self.labels = self.data["part_labels"]

    def subtree(self, j):
        members = [j]
        for k in range(j + 1, 55):
            if PARENTS[k] in members:
                members.append(k)
        return members

    def shaped(self, betas):
        dirs = self.data["shapedirs"][..., : len(betas)]
        return self.vertices + dirs.astype(np.float64) @ betas


@pytest.fixture(scope="session")
def body(body_path):
    return Body(body_path)


def crossing_triangles(vertices, faces):
    """Pairs of triangles without a common vertex that cut each other (edge through face)."""
    corner = vertices[faces]
    centre = corner.mean(1)
    radius = np.linalg.norm(corner - centre[:, None], axis=2).max(1)
    rank = np.floor(np.log2(radius / radius.min())).astype(int)
    classes = [np.flatnonzero(rank == k) for k in np.unique(rank)]
    pairs = []
    for i, small in enumerate(classes):
        tree = cKDTree(centre[small])
        for large in classes[i:]:
            reach = radius[small].max() + radius[large].max()
            near = tree.sparse_distance_matrix(
                cKDTree(centre[large]), reach, output_type="coo_matrix"
            )
            pairs.append(np.stack([small[near.row], large[near.col]], 1))
    pairs = np.concatenate(pairs)
    low, high = corner.min(1), corner.max(1)
    a, b = pairs.T
    keep = ((low[a] <= high[b]) & (low[b] <= high[a])).all(1) & (a != b)
    pairs = pairs[keep]
    shared = (faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None, :]).any((1, 2))
    pairs = np.unique(np.sort(pairs[~shared], axis=1), axis=0)
    hit = np.zeros(len(pairs), dtype=bool)
    for first, second in ((0, 1), (1, 0)):
        tri = corner[pairs[:, first]]
        other = corner[pairs[:, second]]
        e1, e2 = tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]
        for k in range(3):
            start = other[:, k]
            ray = other[:, (k + 1) % 3] - start
            h = np.cross(ray, e2)
            det = (e1 * h).sum(1)
            safe = np.where(np.abs(det) < 1e-18, np.inf, det)
            s = start - tri[:, 0]
            u = (s * h).sum(1) / safe
            q = np.cross(s, e1)
            v = (ray * q).sum(1) / safe
            t = (e2 * q).sum(1) / safe
            inside = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)
            hit |= inside & np.isfinite(safe)
    return pairs[hit]


def test_crossing_triangles_are_found():
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [0.4, 0.3, 1.0],
         [5, 5, 5], [6, 5, 5], [5, 6, 5]], dtype=float
    )  # fmt: skip
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    assert crossing_triangles(vertices, faces).tolist() == [[0, 1]]


def test_layout(body):
    data, count = body.data, len(body.vertices)
    assert count >= 10_000
    shapes = {
        "v_template": (count, 3), "f": (len(body.faces), 3), "shapedirs": (count, 3, 400),
        "posedirs": (count, 3, 486), "J_regressor": (55, count), "weights": (count, 55),
        "kintree_table": (2, 55), "hands_meanl": (45,), "hands_meanr": (45,),
        "hands_componentsl": (45, 45), "hands_componentsr": (45, 45), "lmk_faces_idx": (51,),
        "lmk_bary_coords": (51, 3), "dynamic_lmk_faces_idx": (79, 17),
        "dynamic_lmk_bary_coords": (79, 17, 3), "part_labels": (count,),
        "vertex_colors": (count, 3),
    }  # fmt: skip
    for key, shape in shapes.items():
        assert data[key].shape == shape, key
        assert np.isfinite(data[key]).all(), key
    assert data["f"].dtype == np.uint32
    assert data["part_labels"].dtype == np.int8
    assert data["vertex_colors"].dtype == np.uint8
    for key in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights"):
        assert data[key].dtype == np.float32, key
    dirs = data["shapedirs"]
    used = np.abs(dirs).max((0, 1)) > 0
    assert np.flatnonzero(used).tolist() == [*range(10), *range(300, 310)]
    parents = data["kintree_table"][0].astype(np.int64)
    parents[0] = -1
    assert parents.tolist() == PARENTS
    for side in "lr":
        basis = data[f"hands_components{side}"]
        np.testing.assert_allclose(basis @ basis.T, np.eye(45), atol=1e-10)


def test_body_models_reads_it(body, body_path):
    from body_models.smplx._io import load_model_data

    assets = load_model_data(body_path, flat_hand_mean=True)
    assert assets.joint_names == NAMES
    np.testing.assert_allclose(assets.j_template, body.joints, atol=1e-5)


def test_rest_pose_is_like_smplx(body):
    joints = dict(zip(NAMES, body.joints, strict=True))
    expected = {  # rough places in SMPL-X's neutral rest pose, metres
        "pelvis": (0.0, -0.35, 0.0), "left_hip": (0.07, -0.45, -0.01), "head": (0.0, 0.285, -0.01),
        "left_knee": (0.11, -0.83, -0.02), "left_ankle": (0.09, -1.21, -0.05),
        "left_shoulder": (0.17, 0.09, -0.02), "left_elbow": (0.43, 0.08, -0.04),
        "left_wrist": (0.69, 0.10, -0.04), "neck": (0.0, 0.16, -0.03),
    }  # fmt: skip
    for name, place in expected.items():
        np.testing.assert_allclose(joints[name], place, atol=0.03, err_msg=name)
    for name, place in joints.items():
        if name.startswith("left_"):
            mirror = joints["right_" + name[5:]] * (-1, 1, 1)
            np.testing.assert_allclose(place, mirror, atol=1e-3, err_msg=name)
            assert place[0] > 0
    extent = np.ptp(body.vertices, axis=0)
    assert 1.65 < extent[1] < 1.80
    assert 1.65 < extent[0] < 1.85
    assert joints["left_thumb3"][2] > joints["left_wrist"][2] + 0.03  # thumbs forward


def test_one_closed_oriented_manifold_of_genus_zero(body):
    import trimesh

    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.body_count == 1
    assert 0.050 < mesh.volume < 0.085  # 50 to 85 kg
    directed = np.concatenate([body.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert len(np.unique(body.faces)) == len(body.vertices)
    assert mesh.area_faces.min() > 1e-8
    assert np.degrees(mesh.face_angles).min() > 8.0
    # Every vertex has one fan: walking from face to face about it meets all its faces.
    turned = np.concatenate([np.roll(body.faces, -k, 1) for k in range(3)])
    follow = {(a, b): c for a, b, c in turned.tolist()}
    valence = np.bincount(body.faces.ravel())
    start = dict(zip(body.faces[:, 0].tolist(), body.faces[:, 1].tolist(), strict=True))
    start.update(zip(body.faces[:, 1].tolist(), body.faces[:, 2].tolist(), strict=True))
    start.update(zip(body.faces[:, 2].tolist(), body.faces[:, 0].tolist(), strict=True))
    for vertex, first in start.items():
        at, steps = follow[vertex, first], 1
        while at != first:
            at, steps = follow[vertex, at], steps + 1
        assert steps == valence[vertex]


def test_no_self_intersection_at_rest(body):
    assert len(crossing_triangles(body.vertices, body.faces)) == 0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_self_intersection_at_moderate_shapes(body, seed):
    betas = np.clip(np.random.default_rng(seed).normal(size=10), -2, 2)
    assert len(crossing_triangles(body.shaped(betas), body.faces)) == 0


def test_joints_are_inside(body):
    import igl

    number = igl.winding_number(body.vertices, body.faces, body.joints)
    assert number.min() > 0.5, [NAMES[j] for j in np.flatnonzero(number <= 0.5)]


def test_hands_are_finely_meshed(body):
    edges = np.concatenate([body.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    length = np.linalg.norm(body.vertices[edges[:, 0]] - body.vertices[edges[:, 1]], axis=1)
    for part in (2, 3):
        hand = (body.labels[edges] == part).all(1)
        assert length[hand].max() <= 0.004
    face = np.isin(body.labels[edges], (1, 4)).all(1)
    assert np.median(length[face]) < 0.005


def test_part_labels(body):
    x = body.vertices[:, 0]
    assert set(np.unique(body.labels)) == {0, 1, 2, 3, 4}
    wrist = body.joints[NAMES.index("left_wrist"), 0]
    assert (body.labels[x > wrist + 0.01] == 2).all()
    assert (body.labels[x < -wrist - 0.01] == 3).all()
    assert (np.abs(x[np.isin(body.labels, (2, 3))]) > wrist - 0.01).all()
    front = body.vertices[np.isin(body.labels, (1, 4))]
    assert front[:, 2].min() > 0.0
    assert 0.17 < front[:, 1].min() < 0.24
    eyes = body.vertices[body.labels == 4]
    assert cKDTree(eyes).query(body.joints[[23, 24]])[0].max() < 0.02


def test_weights(body):
    weights = body.weights
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-6)
    assert (weights.max(0) > 0.7).all(), "every joint owns some skin"
    # Smooth: neighbours differ little, except across the eyelids' rim.
    edges = np.concatenate([body.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = edges[(weights[edges][:, :, [23, 24]] < 1e-3).all((1, 2))]
    assert np.abs(weights[edges[:, 0]] - weights[edges[:, 1]]).max() < 0.5
    # Not nearest-bone: transitions hold a good part of the skin.
    assert ((weights > 0.05) & (weights < 0.95)).any(1).mean() > 0.25


def test_fingers_do_not_bleed(body):
    for finger in ("index", "middle", "pinky", "ring", "thumb"):
        own = [NAMES.index(f"left_{finger}{i}") for i in (1, 2, 3)]
        others = [j for j in range(25, 55) if j not in own]
        outer = body.weights[:, own[1:]].sum(1) > 0.95
        assert outer.sum() > 100
        assert body.weights[outer][:, others].max() < 1e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_bending_a_joint_moves_its_own_skin_only(body, axis, sign):
    turn = Rotation.from_rotvec(sign * np.radians(30.0) * np.eye(3)[axis]).as_matrix()
    change = (turn - np.eye(3)).ravel().astype(np.float32)
    posedirs = body.data["posedirs"].reshape(len(body.vertices), 3, 54, 9)
    for j in range(1, 55):
        own = body.weights[:, body.subtree(j)].sum(1)
        corrective = (posedirs[:, :, j - 1] @ change).astype(np.float64)
        shaped = body.vertices + corrective
        # One joint away from rest: skinning reduces to the weight on its subtree.
        moved = own[:, None] * ((shaped - body.joints[j]) @ (turn - np.eye(3)).T) + corrective
        far = own < 1e-3
        assert np.linalg.norm(moved[far], axis=1).max() <= 1e-3, NAMES[j]


def test_jaw_opens_the_lips(body):
    """Lower lip and chin follow the jaw, the upper lip does not."""
    jaw = body.weights[:, NAMES.index("jaw")]
    near = np.abs(body.vertices[:, 0]) < 0.010
    lips = near & (body.vertices[:, 2] > 0.080)
    y = body.vertices[:, 1]
    assert jaw[lips & (y > 0.270) & (y < 0.280)].max() < 0.25
    assert jaw[lips & (y > 0.253) & (y < 0.263)].min() > 0.75
    chin = near & (y > 0.205) & (y < 0.235) & (body.vertices[:, 2] > 0.06)
    assert jaw[chin].min() > 0.6


def test_symmetry(body):
    mirrored = body.vertices * (-1.0, 1.0, 1.0)
    import igl

    squared, _, _ = igl.point_mesh_squared_distance(mirrored, body.vertices, body.faces)
    # Two triangulations of one symmetric surface: they differ by the chords' sagitta.
    assert np.sqrt(squared.max()) < 3.5e-3
    assert np.quantile(np.sqrt(squared), 0.995) < 1.5e-3
    assert np.median(np.sqrt(squared)) < 1e-4


def test_regressor_is_local_and_convex(body):
    regressor = body.regressor
    assert regressor.min() >= 0.0
    np.testing.assert_allclose(regressor.sum(1), 1.0, atol=1e-5)
    for j, row in enumerate(regressor):
        used = np.flatnonzero(row > 0)
        assert len(used) >= 4, NAMES[j]
        spread = np.linalg.norm(body.vertices[used] - body.joints[j], axis=1).max()
        assert spread < (0.035 if j >= 25 else 0.22), NAMES[j]


def test_shape_directions(body):
    rng = np.random.default_rng(3)
    dirs = body.data["shapedirs"][..., :10].astype(np.float64)
    flat = dirs.reshape(-1, 10)
    assert np.linalg.matrix_rank(flat, tol=1e-3) == 10
    median = []
    for _ in range(8):
        betas = rng.normal(size=10)
        betas *= 2.5 / np.linalg.norm(betas)
        median.append(np.median(np.linalg.norm(dirs @ betas, axis=1)))
        joints = body.regressor @ body.shaped(betas)
        import igl

        assert igl.winding_number(body.shaped(betas), body.faces, joints).min() > 0.5
    assert np.mean(median) > 0.015
    assert np.mean(np.asarray(median) > 0.010) > 0.7
    # One unit of stature is a few centimetres.
    assert 0.03 < np.ptp(body.shaped(np.eye(10)[0])[:, 1]) - np.ptp(body.vertices[:, 1]) < 0.09


def test_expression_directions(body):
    dirs = body.data["shapedirs"][..., 300:310].astype(np.float64)
    size = np.linalg.norm(dirs, axis=1)
    assert (size.max(0) > 0.0015).all()
    assert (size.max(0) < 0.008).all()
    moving = size.max(1) > 1e-4
    assert np.isin(body.labels[size.max(1) > 1e-3], (1, 4)).all()
    assert body.vertices[moving, 1].min() > 0.17
    shift = np.einsum("jv,vde->jde", body.regressor, dirs)
    assert np.abs(shift).max() < 2e-4
    # Only the last one is one-sided.
    x = body.vertices[:, 0]
    left, right = size[x > 0.005].max(0), size[x < -0.005].max(0)
    np.testing.assert_allclose(left[:9], right[:9], rtol=0.12)
    assert right[9] < 0.2 * left[9]


def test_pose_correctives(body):
    posedirs = body.data["posedirs"].reshape(len(body.vertices), 3, 54, 9).astype(np.float64)
    for name in ("left_elbow", "left_knee", "left_shoulder", "left_hip", "left_index2"):
        j = NAMES.index(name)
        partner = NAMES.index("right_" + name[5:])
        for axis in range(3):
            turn = Rotation.from_rotvec(np.pi / 2 * np.eye(3)[axis]).as_matrix() - np.eye(3)
            swell = np.linalg.norm(posedirs[:, :, j - 1] @ turn.ravel(), axis=1)
            assert swell.max() <= 7.5e-3
            other = np.linalg.norm(posedirs[:, :, partner - 1] @ turn.ravel(), axis=1)
            np.testing.assert_allclose(swell.max(), other.max(), atol=3e-4)
    bend = Rotation.from_rotvec([0, -np.pi / 2, 0]).as_matrix() - np.eye(3)
    elbow = posedirs[:, :, NAMES.index("left_elbow") - 1] @ bend.ravel()
    assert np.linalg.norm(elbow, axis=1).max() > 2e-3


def test_landmarks_lie_on_the_face(body):
    data = body.data
    for key in ("lmk", "dynamic_lmk"):
        face = data[f"{key}_faces_idx"].ravel()
        bary = data[f"{key}_bary_coords"].reshape(-1, 3)
        np.testing.assert_allclose(bary.sum(1), 1.0, atol=1e-6)
        assert bary.min() >= 0
        assert face.min() >= 0
        assert face.max() < len(body.faces)
    face = data["lmk_faces_idx"]
    points = np.einsum("lk,lkd->ld", data["lmk_bary_coords"], body.vertices[body.faces[face]])
    assert (points[:, 2] > 0.05).all()
    nose, left_eye, right_eye, mouth = points[13], points[25:31], points[19:25], points[31:43]
    assert nose[2] > points[:, 2].max() - 1e-6
    assert left_eye.mean(0)[0] > 0.02
    assert right_eye.mean(0)[0] < -0.02
    assert mouth.mean(0)[1] < nose[1]


def test_hands_flex_towards_the_palm(body):
    """The relaxed hand curls the finger tips down and forwards of a flat hand, on both sides."""
    for side, key in (("left", "hands_meanl"), ("right", "hands_meanr")):
        pose = body.data[key].reshape(15, 3)
        first = NAMES.index(f"{side}_index1")
        for finger in (0, 1, 2, 3):
            matrix = np.eye(3)
            joint = first + 3 * finger
            tip = body.joints[joint + 2] - body.joints[joint + 1]
            for k in range(2):
                matrix = matrix @ Rotation.from_rotvec(pose[3 * finger + k]).as_matrix()
            assert (matrix @ tip)[1] < tip[1] - 0.01


def test_another_processor_makes_the_same_mesh(body):
    """Powers and exponentials differ there in the last bits, and with them the field."""
    from xavatar_jax.synthetic.body.anatomy import BODY_BOX, Person
    from xavatar_jax.synthetic.body.octree import extract
    from xavatar_jax.synthetic.body.remesh import remesh
    from xavatar_jax.synthetic.body.sizing import edge_length, leaf_size, longest_edge
    from xavatar_jax.synthetic.body.untangle import untangle

    person, rng = Person(), np.random.default_rng(3)

    def field(points):
        value = person(points)
        return value + rng.choice([-1, 0, 1], size=value.shape) * np.spacing(np.abs(value))

    vertices, faces = remesh(field, *extract(field, leaf_size, BODY_BOX), edge_length, longest_edge)
    vertices = untangle(vertices.astype(np.float32).astype(np.float64), faces)
    np.testing.assert_array_equal(faces, body.faces)
    np.testing.assert_array_equal(vertices.astype(np.float32), body.data["v_template"])


def test_the_version_changes_with_the_arrays(body_path):
    """Cache entries are keyed by the version, avatar files name the checksum."""
    found = load_body(body_path, num_betas=10, num_expression=10)
    assert synthetic.body.SYNTHETIC_BODY_VERSION == "5"
    assert found.source.checksum.startswith("4c261f8092f1")


def test_a_damaged_body_in_the_cache_is_built_again(body_path, tmp_path, monkeypatch):
    monkeypatch.setattr(
        build_module, "write_synthetic_body", lambda path: shutil.copy(body_path, path)
    )
    checksum = synthetic.synthetic_body(tmp_path).source.checksum
    (path,) = tmp_path.iterdir()
    for data in (path.read_bytes()[:100_000], b"", bytes(1000)):
        path.write_bytes(data)
        with pytest.warns(CacheNotice, match=r"synthetic_body-5\.npz: damaged cache entry"):
            assert synthetic.synthetic_body(tmp_path).source.checksum == checksum


def test_interrupted_writing_leaves_nothing(tmp_path, monkeypatch):
    def stop(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(build_module, "build_synthetic_body", lambda verbose: {})
    monkeypatch.setattr(np, "savez_compressed", stop)
    with pytest.raises(OSError, match="disk full"):
        synthetic.write_synthetic_body(tmp_path / "body.npz")
    assert os.listdir(tmp_path) == []
