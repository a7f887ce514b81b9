import numpy as np
import pytest

from xavatar_jax.body import BodyParams, pose_body
from xavatar_jax.files.meshes import read_mesh
from xavatar_jax.frames import Frames, frames_from_params, nearest_part_labels, spread

TETRA = (
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def some_params(body, count, seed=0):
    rng = np.random.default_rng(seed)
    return BodyParams.create(
        body,
        pose=0.2 * rng.normal(size=(count, body.num_joints, 3)),
        betas=np.tile(rng.normal(size=10), (count, 1)),
        transl=rng.normal(size=(count, 3)),
    )


def tetra_frames(body, sizes):
    count = sum(sizes)
    return Frames.from_meshes(
        [TETRA] * count,
        some_params(body, count),
        sequence_names=[f"s{i}" for i in range(len(sizes))],
        sequence_index=np.repeat(np.arange(len(sizes)), sizes),
    )


def test_frames_are_posed_only_when_asked_for(toy_body):
    calls = []

    def load(i):
        calls.append(i)
        return TETRA

    frames = Frames(some_params(toy_body, 5), load)
    assert len(frames) == 5
    assert calls == []
    view = frames[1:][np.array([0, 3])]
    assert calls == []
    assert view[1].source == "frame 4"
    assert frames[-1].source == "frame 4"
    assert calls == [4, 4]


def test_frames_from_params_pose_the_body(toy_body):
    params = some_params(toy_body, 3)
    frames = frames_from_params(toy_body, params)
    expected = pose_body(toy_body, params[1]).vertices
    np.testing.assert_allclose(frames[1].vertices, expected, atol=1e-6)
    np.testing.assert_array_equal(frames[1].params.pose, params.pose[1])
    np.testing.assert_array_equal(frames[1].part_labels, toy_body.part_labels)


def test_views_keep_params_sequences_and_sources_together(toy_body):
    frames = tetra_frames(toy_body, (4, 3))
    view = frames[np.array([5, 0])]
    assert view.sources == ("frame 5", "frame 0")
    assert list(view.sequences) == ["s1", "s0"]
    np.testing.assert_array_equal(view.params.transl[0], frames.params.transl[5])
    assert [len(s) for s in frames.sequences.values()] == [4, 3]
    assert [f.source for f in frames[2:4]] == ["frame 2", "frame 3"]


def test_meshes_may_be_paths_objects_or_pairs(toy_body, tmp_path):
    import trimesh

    mesh = trimesh.Trimesh(*TETRA, process=False)
    path = tmp_path / "t.ply"
    mesh.export(path)
    frames = Frames.from_meshes([path, mesh, TETRA], some_params(toy_body, 3))
    for frame in frames:
        np.testing.assert_allclose(frame.vertices, TETRA[0], atol=1e-6)
        np.testing.assert_array_equal(frame.faces, TETRA[1])


def test_bad_frames_are_refused_by_name(toy_body):
    params = some_params(toy_body, 2)
    with pytest.raises(ValueError, match="3 meshes but parameters for 2 frames"):
        Frames.from_meshes([TETRA] * 3, params)
    empty = (np.zeros((0, 3)), np.zeros((0, 3), int))
    frames = Frames.from_meshes([TETRA, empty], params, sources=["good", "bad"])
    with pytest.raises(ValueError, match=r"bad: the mesh has no vertices"):
        frames[1]
    with pytest.raises(ValueError, match="one batch axis"):
        Frames.from_meshes([TETRA], params[0])
    with pytest.raises(ValueError, match=r"part labels of shape \(3,\) for 4 vertices"):
        Frames.from_meshes([TETRA] * 2, params, part_labels=np.zeros(3))[0]
    with pytest.raises(ValueError, match="leaves no frames"):
        frames[5:]
    with pytest.raises(IndexError):
        frames[2]
    with pytest.raises(ValueError, match="Not a mesh"):
        Frames.from_meshes([TETRA, 3], params)[1]


@pytest.mark.parametrize("name", ["pose", "betas", "transl", "expression"])
def test_nan_parameters_name_the_frame_and_the_field(toy_body, name):
    from dataclasses import replace

    params = some_params(toy_body, 3)
    broken = np.array(getattr(params, name))
    broken[2].flat[0] = np.nan
    params = replace(params, **{name: broken})
    with pytest.raises(ValueError, match=f"c: params.{name} is not finite"):
        Frames.from_meshes([TETRA] * 3, params, sources=["a", "b", "c"])


@pytest.mark.parametrize(
    ("sizes", "n", "counts"),
    [
        ((100, 100, 100), 24, [8, 8, 8]),
        ((100, 3, 100), 24, [11, 3, 10]),
        ((5, 5, 5), 2, [1, 0, 1]),
        ((2, 2), 9, [2, 2]),
    ],
)
def test_spread_shares_frames_among_sequences(toy_body, sizes, n, counts):
    frames = tetra_frames(toy_body, sizes)
    chosen = spread(frames, n)
    assert len(set(chosen)) == min(n, sum(sizes))
    assert sorted(chosen) == list(chosen)
    found = np.bincount(frames.sequence_index[chosen], minlength=len(sizes))
    np.testing.assert_allclose(found, counts, atol=1)
    assert found.sum() == sum(counts)


def test_spread_is_even_in_time(toy_body):
    chosen = spread(tetra_frames(toy_body, (100,)), 5)
    np.testing.assert_array_equal(chosen, [10, 30, 50, 70, 90])
    with pytest.raises(ValueError, match="at least 1"):
        spread(tetra_frames(toy_body, (3,)), 0)


def test_nearest_labels_recover_the_bodys_own(toy_body):
    params = some_params(toy_body, 1)[0]
    vertices = np.asarray(pose_body(toy_body, params).vertices)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(vertices))
    labels = nearest_part_labels(toy_body, params, vertices[order])
    assert (labels == np.asarray(toy_body.part_labels)[order]).mean() > 0.97


def test_read_mesh_keeps_every_vertex_of_an_obj_with_seams(tmp_path):
    path = tmp_path / "seams.obj"
    path.write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 9 9 9\nvt 0 0\nvt 1 1\n"
        "usemtl a\nf 1/1 2/1 3/2\nusemtl b\nf 1/2 3/1 4/2\n"
    )
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices[4], [9, 9, 9])
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3]])


def test_read_mesh_keeps_every_vertex_of_a_ply_with_texture_coordinates(tmp_path):
    """Of its corners, and different at the two of a vertex, as a seam has them."""
    path = tmp_path / "seams.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n9 9 9\n"
        "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0.5 0.5 0.2 0.2 0 1\n"
    )
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices[4], [9, 9, 9])
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", "hello", "not a readable mesh"),
        ("a.obj", "v 0 0 0\nv 1 0 0\n", "no vertices|no triangles"),
        ("a.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("a.txt", "v", "cannot read a mesh"),
    ],
)
def test_unreadable_meshes_name_the_file(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        read_mesh(path)
    assert str(path) in str(error.value)


def test_missing_mesh(tmp_path):
    with pytest.raises(FileNotFoundError, match="No mesh file at"):
        read_mesh(tmp_path / "none.ply")


def test_a_mesh_inside_out_is_turned_round(toy_body):
    vertices, faces = TETRA
    meshes = [TETRA, (vertices, faces[:, ::-1])]
    frames = Frames.from_meshes(meshes, some_params(toy_body, 2))
    assert [frame.turned for frame in frames] == [False, True]
    for frame in frames:
        a, b, c = (frame.vertices[frame.faces[:, k]] - 0.2 for k in range(3))
        assert ((np.cross(b - a, c - a) * a).sum(1) > 0).all()  # outwards from a point inside


def test_labels_may_be_a_function_of_the_vertices_that_were_read(toy_body):
    calls = []

    def load(i):
        calls.append(i)
        return TETRA

    frames = Frames(some_params(toy_body, 2), load, part_labels=lambda i, v: i + (v[:, 0] > 0))
    np.testing.assert_array_equal(frames[1].part_labels, [1, 2, 1, 1])
    assert calls == [1]


def test_frames_are_compared_by_identity(toy_body):
    frames = tetra_frames(toy_body, (2,))
    frame = frames[0]
    assert frame == frame
    assert frame != frames[0]
    assert frames == frames
    assert frames != frames[:]
    assert len({frame, frames}) == 2
