import numpy as np
import pytest
import trimesh
from toy_smplx import write_toy_body

from xavatar_jax.body import load_body, pose_body, with_template
from xavatar_jax.datasets import find_gender, load_data, load_grab
from xavatar_jax.datasets.capture import CaptureNotice, split_names


def write_sequence(path, *, count=4, seed=0, gender="neutral", betas=None, fps=30.0, split=True):
    """A GRAB sequence as AMASS publishes it, written by hand."""
    rng = np.random.default_rng(seed)
    poses = 0.3 * rng.normal(size=(count, 165))
    poses[:, :3] = [np.pi / 2, 0, 0]  # upright in a z-up world
    arrays = {
        "gender": gender, "surface_model_type": "smplx", "mocap_frame_rate": fps,
        "trans": rng.normal(size=(count, 3)), "betas": np.ones(16) if betas is None else betas,
        "root_orient": poses[:, :3], "pose_body": poses[:, 3:66], "pose_hand": poses[:, 75:],
        "pose_jaw": poses[:, 66:69], "pose_eye": poses[:, 69:75],
    }  # fmt: skip
    if not split:
        arrays["poses"] = poses
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
    return arrays


BETAS = np.concatenate([np.linspace(-1, 1, 10), np.zeros(6)])


@pytest.fixture
def split_folder(tmp_path):
    write_sequence(tmp_path / "s/train/cup_drink_1_stageii.npz", seed=1, betas=BETAS)
    write_sequence(tmp_path / "s/train/phone_call_1_stageii.npz", seed=2, count=3, betas=BETAS)
    write_sequence(tmp_path / "s/test/box_lift_1_stageii.npz", seed=3, betas=BETAS)
    return tmp_path / "s"


def test_split_folder_is_read_upright_and_in_place(toy_body, split_folder):
    capture = load_grab(split_folder, toy_body)
    assert (len(capture.train), len(capture.test)) == (7, 4)
    assert list(capture.train.sequences) == ["cup_drink_1", "phone_call_1"]
    assert (capture.gender, capture.fps, capture.name) == ("neutral", 30.0, "s")
    np.testing.assert_allclose(capture.betas, BETAS[:10], atol=1e-6)
    assert capture.notices == ()  # the six betas that the body lacks are zero
    assert "phone_call_1_stageii.npz, frame 2" in capture.train[6].source
    # By hand: pose in the file's world with a y-up body, then turn the vertices.
    data = np.load(split_folder / "train/cup_drink_1_stageii.npz")
    from xavatar_jax.body import BodyParams

    parts = [data[k][2] for k in ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")]
    params = BodyParams.create(
        toy_body, pose=np.concatenate(parts), betas=BETAS[:10], transl=data["trans"][2]
    )
    world = np.asarray(pose_body(toy_body, params).vertices)
    expected = world[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(capture.train[2].vertices, expected, atol=1e-5)
    np.testing.assert_array_equal(capture.train[2].part_labels, toy_body.part_labels)


@pytest.fixture
def subject_folder(tmp_path):
    for i in range(13):
        write_sequence(tmp_path / f"s1/seq{i:02d}_stageii.npz", seed=i, betas=BETAS, count=2)
    (tmp_path / "s1/female_stagei.npz").write_bytes(b"the shape fit, no motion")
    return tmp_path / "s1"


def test_subject_folder_is_split_nine_to_three_by_seed(toy_body, subject_folder):
    first = load_grab(subject_folder, toy_body)
    again = load_grab(subject_folder, toy_body)
    other = load_grab(subject_folder, toy_body, split_seed=1)
    names = [list(getattr(first, part).sequences) for part in ("train", "test")]
    assert [len(n) for n in names] == [9, 3]
    assert not set(names[0]) & set(names[1])
    assert names[1] == list(again.test.sequences)
    assert names[1] != list(other.test.sequences)
    assert any("1 sequences used neither" in notice for notice in first.notices)


def test_sequences_are_held_out_by_name(toy_body, subject_folder):
    capture = load_grab(subject_folder, toy_body, test=["seq03", "seq05_stageii.npz"])
    assert list(capture.test.sequences) == ["seq03", "seq05"]
    assert len(capture.train.sequences) == 11
    with pytest.raises(ValueError, match=r"test sequences nope not found; there are seq00"):
        load_grab(subject_folder, toy_body, test=["nope"])


def test_a_split_folder_takes_no_names(toy_body, split_folder):
    with pytest.raises(ValueError, match="split into train and test already"):
        load_grab(split_folder, toy_body, test=["cup_drink_1"])


@pytest.mark.parametrize(("count", "sizes"), [(12, (9, 3)), (8, (6, 2)), (4, (3, 1)), (2, (1, 1))])
def test_split_sizes(count, sizes):
    names = [str(i) for i in range(count)]
    parts = split_names(names, test=None, seed=0, source="x")
    assert tuple(map(len, parts)) == sizes
    assert sorted(parts[0] + parts[1], key=int) == names


def test_one_sequence_cannot_be_split():
    with pytest.raises(ValueError, match="only 1 sequence"):
        split_names(["a"], test=None, seed=0, source="x")


def test_gender_mismatch_is_an_error_unless_overridden(toy_body, tmp_path):
    write_sequence(tmp_path / "train/a.npz", gender="female")
    write_sequence(tmp_path / "test/b.npz", gender="female")
    with pytest.raises(ValueError, match=r"sequences is female, but the body .* is neutral"):
        load_grab(tmp_path, toy_body)
    with pytest.warns(CaptureNotice, match="files say female, taken as neutral"):
        assert load_grab(tmp_path, toy_body, gender="neutral").gender == "neutral"
    with pytest.raises(ValueError, match="gender asked for is male, but the body"):
        load_grab(tmp_path, toy_body, gender="male")
    assert find_gender(tmp_path) == "female"


def test_sequences_of_two_genders_are_an_error(toy_body, tmp_path):
    write_sequence(tmp_path / "train/a.npz", gender="female")
    write_sequence(tmp_path / "test/b.npz", gender="male")
    with pytest.raises(ValueError, match="different gender"):
        load_grab(tmp_path, toy_body)


def test_shapes_that_differ_become_their_mean_with_a_notice(toy_body, tmp_path):
    write_sequence(tmp_path / "train/a.npz", betas=np.zeros(10))
    write_sequence(tmp_path / "test/b.npz", betas=np.full(10, 0.5))
    with pytest.warns(CaptureNotice, match="betas of one subject differ"):
        capture = load_grab(tmp_path, toy_body)
    np.testing.assert_allclose(capture.betas, 0.25)
    np.testing.assert_allclose(capture.test.params.betas, 0.25)
    assert any("differ" in notice for notice in capture.notices)


def test_cut_coefficients_are_recorded(toy_body, tmp_path):
    write_sequence(tmp_path / "train/a.npz")
    write_sequence(tmp_path / "test/b.npz")
    notices = load_grab(tmp_path, toy_body).notices
    assert len(notices) == 2
    assert all("16 betas given, the body has 10" in notice for notice in notices)


def test_sequences_keep_their_frame_rates_unless_resampled(toy_body, tmp_path):
    write_sequence(tmp_path / "train/a.npz", fps=120.0, count=9, betas=BETAS)
    write_sequence(tmp_path / "test/b.npz", fps=30.0, count=3, betas=BETAS)
    capture = load_grab(tmp_path, toy_body)
    assert (len(capture.train), len(capture.test)) == (9, 3)
    assert np.isnan(capture.fps)
    assert capture.notices == (f"{tmp_path}: frame rates of 30, 120; each sequence keeps its own.",)
    capture = load_grab(tmp_path, toy_body, fps=30.0)
    assert (len(capture.train), len(capture.test), capture.fps) == (3, 3, 30.0)
    assert capture == capture  # by identity: arrays have no single truth value


def test_an_empty_split_names_the_folder(toy_body, tmp_path):
    write_sequence(tmp_path / "train/a.npz")
    with pytest.raises(FileNotFoundError, match=r"test: no \*.npz"):
        load_grab(tmp_path, toy_body)


def test_the_subjects_template_replaces_the_shape(toy_body, tmp_path):
    own = np.asarray(toy_body.template) * [1.05, 1.1, 0.95]
    mesh = tmp_path / "tools/subject_meshes/s1.ply"
    mesh.parent.mkdir(parents=True)
    trimesh.Trimesh(own, toy_body.faces, process=False).export(mesh)
    for part in ("train", "test"):
        pose = np.zeros((2, 165))
        pose[:, :3] = [np.pi / 2, 0, 0]
        folder = tmp_path / f"grab/s1/{part}"
        folder.mkdir(parents=True)
        params = {"fullpose": pose, "transl": np.zeros((2, 3)), "expression": np.zeros((2, 10))}
        body = {"params": params, "vtemp": "tools/subject_meshes/s1.ply"}
        np.savez(folder / "x.npz", gender="neutral", framerate=120.0, body=body)
    capture = load_grab(tmp_path / "grab/s1", toy_body)
    np.testing.assert_array_equal(capture.betas, 0)
    np.testing.assert_allclose(capture.body.template, own, atol=1e-6)
    # Pose correctives of the root do not exist: the rest pose is the template, turned upright.
    pelvis = np.asarray(with_template(toy_body, own.astype(np.float32)).joint_template[0])
    turned = (own - pelvis) @ np.array([[1, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]).T
    expected = turned @ np.array([[1, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]).T
    found = capture.train[0].vertices
    np.testing.assert_allclose(found - found.mean(0), expected - expected.mean(0), atol=1e-5)
    mesh.unlink()
    with pytest.raises(FileNotFoundError, match=r"tools/subject_meshes/s1.ply.*Pass template="):
        load_grab(tmp_path / "grab/s1", toy_body)


def test_a_template_of_other_topology_is_refused(toy_body, split_folder, tmp_path):
    trimesh.creation.icosphere(1).export(tmp_path / "t.ply")
    with pytest.raises(ValueError, match="the template has 42 vertices"):
        load_grab(split_folder, toy_body, template=tmp_path / "t.ply")


def test_unknown_layouts_list_what_was_sought_and_found(toy_body, tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(FileNotFoundError) as error:
        load_data(tmp_path, toy_body)
    for word in ("train/*.npz", "SMPLX/mesh-f*", "NAME.ply|obj", "Found: notes.txt"):
        assert word in str(error.value)
    with pytest.raises(FileNotFoundError, match="No data folder at"):
        load_data(tmp_path / "nowhere", toy_body)
    with pytest.raises(FileNotFoundError, match="no sequences"):
        load_grab(tmp_path, toy_body)
    assert find_gender(tmp_path) is None


def test_load_data_finds_grab(toy_body, split_folder):
    assert len(load_data(split_folder, toy_body).train) == 7


def test_a_body_named_otherwise_counts_as_the_gender_it_was_loaded_for(tmp_path, split_folder):
    write_sequence(tmp_path / "f/train/a.npz", gender="male")
    write_sequence(tmp_path / "f/test/b.npz", gender="male")
    body = load_body(write_toy_body(tmp_path / "SMPLX_MALE.npz"), num_betas=10, num_expression=10)
    assert load_grab(tmp_path / "f", body).gender == "male"
    with pytest.raises(ValueError, match="sequences is neutral, but the body"):
        load_grab(split_folder, body)


def test_a_tilde_is_the_home_folder(toy_body, split_folder, monkeypatch):
    monkeypatch.setenv("HOME", str(split_folder.parent))
    assert len(load_grab("~/s", toy_body).train) == 7
    assert len(load_data("~/s", toy_body).train) == 7
    assert find_gender("~/s") == "neutral"


def test_scans_beside_motions_are_not_ignored_silently(toy_body, split_folder):
    for folder in ("scans", "preview"):
        (split_folder / folder).mkdir()
    trimesh.creation.icosphere(1).export(split_folder / "scans/a.ply")
    with pytest.raises(ValueError, match="scans: scans in a layout that is not supported"):
        load_data(split_folder, toy_body)
    (split_folder / "scans/a.ply").rename(split_folder / "preview/a.ply")
    with pytest.warns(CaptureNotice, match="preview: 1 mesh files are ignored"):
        load_data(split_folder, toy_body)
