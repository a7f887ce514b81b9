import pickle
import shutil

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from xavatar_jax.body import BodyParams, load_body, pose_body, pose_groups
from xavatar_jax.datasets import find_gender, load_data, load_folder, load_frames, load_prepared
from xavatar_jax.datasets import scans as scans_module
from xavatar_jax.datasets.capture import CaptureNotice
from xavatar_jax.files.meshes import read_mesh

BETAS = np.linspace(-0.8, 0.8, 10)
SIZES = {
    "global_orient": 3, "body_pose": 63, "left_hand_pose": 45, "right_hand_pose": 45,
    "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3, "transl": 3, "expression": 10,
}  # fmt: skip


def frame_params(seed):
    rng = np.random.default_rng(seed)
    return {name: 0.3 * rng.normal(size=size) for name, size in SIZES.items()}


def absolute_hands(body, params):
    """By hand: the mean hand, in the order of the tree, added to relative hands."""
    mean = np.asarray(body.hand_mean)
    return {
        **params,
        "left_hand_pose": params["left_hand_pose"] + mean[25:40].reshape(-1),
        "right_hand_pose": params["right_hand_pose"] + mean[40:55].reshape(-1),
    }


def posed_mesh(body, params):
    vertices = pose_body(body, BodyParams.create(body, betas=BETAS, **params)).vertices
    return trimesh.Trimesh(np.asarray(vertices), body.faces, process=False)


def write_prepared(root, body):
    """What the reference's preparation leaves: hands relative to the mean, stdlib pickles."""
    seed = 0
    for part, sequence, count in (("train", "a", 2), ("train", "b", 1), ("test", "c", 2)):
        folder = root / part / sequence / "SMPLX"
        folder.mkdir(parents=True)
        for i in range(count):
            params = frame_params(seed)
            seed += 1
            posed_mesh(body, absolute_hands(body, params)).export(
                folder / f"mesh-f{i:06d}_smplx.ply"
            )
            stored = {k: v.astype(np.float32) for k, v in params.items()} | {"betas": np.zeros(10)}
            with open(folder / f"mesh-f{i:06d}_smplx.pkl", "wb") as file:
                pickle.dump(stored, file)
    (root / "gender.txt").write_text("neutral\n")
    np.save(root / "mean_shape_smplx.npy", BETAS)
    return root


@pytest.fixture(scope="module")
def prepared(toy_body, tmp_path_factory):
    return write_prepared(tmp_path_factory.mktemp("prepared") / "00001", toy_body)


def test_prepared_meshes_agree_with_their_parameters(toy_body, prepared):
    capture = load_data(prepared.parent, toy_body)
    assert (capture.name, capture.gender, capture.notices) == ("00001", "neutral", ())
    assert list(capture.train.sequences) == ["a", "b"]
    assert (len(capture.train), len(capture.test)) == (3, 2)
    np.testing.assert_allclose(capture.betas, BETAS)
    for frame in (*capture.train, *capture.test):
        posed = pose_body(toy_body, frame.params).vertices
        np.testing.assert_allclose(frame.vertices, posed, atol=1e-5)
        np.testing.assert_array_equal(frame.part_labels, toy_body.part_labels)
    assert find_gender(prepared) == "neutral"


def test_meshes_of_other_topology_get_the_nearest_labels(toy_body, prepared, tmp_path):
    shutil.copytree(prepared, tmp_path / "s")
    path = tmp_path / "s/train/a/SMPLX/mesh-f000000_smplx.ply"
    mesh = trimesh.load_mesh(path, process=False)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    kept = len(vertices) // 2
    faces = faces[(faces < kept).all(1)]
    trimesh.Trimesh(vertices[:kept], faces, process=False).export(path)
    frame = load_prepared(tmp_path / "s", toy_body).train[0]
    assert len(frame.vertices) == kept
    assert (frame.part_labels == toy_body.part_labels[:kept]).mean() > 0.97


def test_two_subjects_are_not_one_person(toy_body, prepared, tmp_path):
    for name in ("00001", "00002"):
        shutil.copytree(prepared, tmp_path / name)
    with pytest.raises(ValueError, match="2 subjects"):
        load_data(tmp_path, toy_body)


@pytest.mark.parametrize(("lost", "lacking"), [(".ply", "ply mesh"), (".pkl", "pkl parameters")])
def test_a_frame_without_its_partner_is_an_error(toy_body, prepared, tmp_path, lost, lacking):
    shutil.copytree(prepared, tmp_path / "s")
    (tmp_path / f"s/train/b/SMPLX/mesh-f000000_smplx{lost}").unlink()
    with pytest.raises(FileNotFoundError, match=f"mesh-f000000_smplx.*no .{lacking}"):
        load_prepared(tmp_path / "s", toy_body)


class Evil:
    def __reduce__(self):
        return (print, ("run",))


def test_code_in_a_pickle_is_refused(toy_body, prepared, tmp_path):
    shutil.copytree(prepared, tmp_path / "s")
    path = tmp_path / "s/test/c/SMPLX/mesh-f000001_smplx.pkl"
    path.write_bytes(pickle.dumps({**frame_params(0), "betas": Evil()}))
    with pytest.raises(ValueError, match="not plain data") as error:
        load_prepared(tmp_path / "s", toy_body)
    assert "mesh-f000001_smplx.pkl" in str(error.value)


def test_an_unreadable_mesh_is_an_error_when_asked_for(toy_body, prepared, tmp_path):
    shutil.copytree(prepared, tmp_path / "s")
    (tmp_path / "s/test/c/SMPLX/mesh-f000001_smplx.ply").write_text("no mesh")
    capture = load_prepared(tmp_path / "s", toy_body)
    capture.test[0]
    with pytest.raises(ValueError, match=r"mesh-f000001_smplx.ply: not a readable mesh"):
        capture.test[1]


def write_frame(folder, name, body, seed, *, mesh=".ply", params=".npz", **changes):
    folder.mkdir(parents=True, exist_ok=True)
    values = frame_params(seed)
    posed_mesh(body, values).export(folder / f"{name}{mesh}")
    stored = {**values, "betas": BETAS, **changes}
    if params == ".npz":
        np.savez(folder / f"{name}.npz", **stored)
    else:
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(stored))
    return values


def test_every_shape_of_a_pose_means_the_same(toy_body, tmp_path):
    values = frame_params(7)
    body_pose = values["body_pose"].reshape(21, 3)
    matrices = Rotation.from_rotvec(body_pose).as_matrix()
    for i, shaped in enumerate((body_pose, body_pose.reshape(1, 63), matrices)):
        write_frame(tmp_path / "f", f"frame{i}", toy_body, 7, body_pose=shaped)
    write_frame(tmp_path / "f", "frame3", toy_body, 7, mesh=".obj", params=".pkl")
    frames = load_frames(tmp_path / "f", toy_body)
    assert len(frames) == 4
    np.testing.assert_allclose(frames.params.body_pose, np.tile(body_pose, (4, 1, 1)), atol=1e-6)
    for frame in frames:
        posed = pose_body(toy_body, frame.params).vertices
        np.testing.assert_allclose(frame.vertices, posed, atol=1e-5)


def test_relative_hands_by_argument_or_by_file(toy_body, tmp_path):
    values = write_frame(tmp_path / "f", "a", toy_body, 3)
    write_frame(tmp_path / "f", "b", toy_body, 3, flat_hand_mean=False)
    # The mesh of `a` fits absolute hands, so nothing is said of it.
    hands = load_frames(tmp_path / "f", toy_body).params.left_hand_pose
    np.testing.assert_allclose(hands[0].reshape(-1), values["left_hand_pose"], atol=1e-6)
    mean = np.asarray(toy_body.hand_mean)[25:40]
    np.testing.assert_allclose(hands[1] - hands[0], mean, atol=1e-6)
    with pytest.warns(CaptureNotice, match="is the mean hand added twice, or missing"):
        load_frames(tmp_path / "f", toy_body, flat_hand_mean=False)
    with pytest.warns(CaptureNotice, match="is the mean hand added twice, or missing"):
        capture = load_data(tmp_path / "f", toy_body, flat_hand_mean=False)
    hands = np.concatenate([c.params.left_hand_pose for c in (capture.train, capture.test)])
    np.testing.assert_allclose(
        hands[0].reshape(-1), values["left_hand_pose"] + mean.ravel(), atol=1e-6
    )


def test_a_layout_that_knows_its_hands_is_not_told(prepared, toy_body):
    with pytest.raises(ValueError, match="hands are relative to the mean hand in this layout"):
        load_data(prepared, toy_body, flat_hand_mean=True)


def test_train_and_test_subfolders_make_the_split(toy_body, tmp_path):
    for i, name in enumerate(("train/s1/a", "train/s1/b", "train/s2/a", "test/s3/a")):
        folder, stem = (tmp_path / name).parent, name[-1]
        write_frame(folder, stem, toy_body, i)
    capture = load_data(tmp_path, toy_body)
    assert list(capture.train.sequences) == ["train/s1", "train/s2"]
    assert list(capture.test.sequences) == ["test/s3"]
    np.testing.assert_allclose(capture.betas, BETAS)


def test_sequences_or_trailing_frames_are_held_out(toy_body, tmp_path):
    for s in range(4):
        write_frame(tmp_path / f"many/s{s}", "a", toy_body, s)
    capture = load_folder(tmp_path / "many", toy_body)
    assert (len(capture.train.sequences), len(capture.test.sequences)) == (3, 1)
    named = load_folder(tmp_path / "many", toy_body, test=["s2"])
    assert list(named.test.sequences) == ["s2"]
    for i in range(5):
        write_frame(tmp_path / "one", f"f{i}", toy_body, i)
    capture = load_folder(tmp_path / "one", toy_body)
    assert (len(capture.train), len(capture.test)) == (4, 1)
    assert capture.test[0].source.endswith("f4.ply")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body_pose": np.zeros(60)}, r"body_pose has shape \(60,\), expected \(63,\)"),
        ({"transl": np.full(3, np.nan)}, "transl is not finite"),
        ({"left_hand_pose": np.zeros((2, 45))}, r"left_hand_pose has shape \(2, 45\)"),
    ],
)
def test_bad_parameters_name_the_file(toy_body, tmp_path, changes, message):
    write_frame(tmp_path, "a", toy_body, 0, **changes)
    with pytest.raises(ValueError, match=message) as error:
        load_frames(tmp_path, toy_body)
    assert "a.npz" in str(error.value)


def test_missing_parameters_and_partners_are_named(toy_body, tmp_path):
    write_frame(tmp_path / "k", "a", toy_body, 0)
    np.savez(tmp_path / "k/a.npz", body_pose=np.zeros(63), transl=np.zeros(3))
    with pytest.raises(ValueError, match=r"no global_orient or .*; found body_pose, tra"):
        load_frames(tmp_path / "k", toy_body)
    write_frame(tmp_path / "m", "a", toy_body, 0)
    write_frame(tmp_path / "m", "b", toy_body, 0)
    (tmp_path / "m/b.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"b.ply: no parameters beside it \(b.npz"):
        load_frames(tmp_path / "m", toy_body)
    (tmp_path / "m/a.ply").rename(tmp_path / "m/b.obj")
    with pytest.raises(ValueError, match=r"are of one frame"):
        load_frames(tmp_path / "m", toy_body)
    (tmp_path / "m/b.obj").unlink()
    with pytest.raises(FileNotFoundError, match="no parameters beside it"):
        load_frames(tmp_path / "m", toy_body)
    with pytest.raises(FileNotFoundError, match=r"no frames. A frame is NAME.ply"):
        load_frames(tmp_path / "empty", toy_body)


def test_parameters_without_a_mesh_are_named(toy_body, tmp_path):
    write_frame(tmp_path, "a", toy_body, 0)
    write_frame(tmp_path, "b", toy_body, 0)
    (tmp_path / "a.ply").unlink()
    with pytest.raises(FileNotFoundError, match=r"a.npz: no mesh beside it"):
        load_frames(tmp_path, toy_body)


def test_meshes_in_millimetres_are_noticed(toy_body, tmp_path):
    values = write_frame(tmp_path, "a", toy_body, 0)
    mesh = posed_mesh(toy_body, values)
    mesh.apply_scale(1000.0)
    mesh.export(tmp_path / "a.ply")
    with pytest.raises(ValueError, match=r"do not belong together.*units \(metres\)"):
        load_frames(tmp_path, toy_body)


@pytest.mark.parametrize("scans", ["meshes_pkl", "meshes_ply"])
def test_scans_of_x_humans_are_what_is_learned_from(toy_body, prepared, tmp_path, scans):
    """They stand beside the registered body of each frame, and are not it."""
    subject = shutil.copytree(prepared, tmp_path / "00016")
    for folder in subject.glob("*/*/SMPLX"):
        (folder.parent / scans).mkdir()
        for params in folder.glob("*.pkl"):
            name = params.stem.removesuffix("_smplx")
            mesh = trimesh.load_mesh(params.with_suffix(".ply"), process=False).subdivide()
            if scans == "meshes_ply":
                mesh.export(folder.parent / scans / f"{name}.ply")
            else:
                held = {"vertices": np.asarray(mesh.vertices), "faces": np.asarray(mesh.faces)}
                held |= {"uvs": np.zeros((len(mesh.faces), 6))}
                (folder.parent / scans / f"{name}.pkl").write_bytes(pickle.dumps(held))
                (folder.parent / scans / f"atlas-{name[5:]}.pkl").write_bytes(b"a picture")
    capture = load_data(subject, toy_body)
    assert (len(capture.train), len(capture.test)) == (3, 2)
    for frame in (*capture.train, *capture.test):
        assert len(frame.vertices) > 3 * toy_body.num_vertices
        assert f"/{scans}/mesh-f" in frame.source
    lost = next(subject.glob(f"train/*/{scans}/mesh-f*"))
    lost.unlink()
    with pytest.raises(FileNotFoundError, match=r"_smplx\.pkl: no \.ply mesh"):
        load_data(subject, toy_body)


def test_a_pickle_that_is_no_mesh_says_what_it_holds(tmp_path):
    file = tmp_path / "mesh-f00001.pkl"
    file.write_bytes(pickle.dumps({"vertices": np.zeros((3, 3)), "uvs": np.zeros(2)}))
    with pytest.raises(ValueError, match=r"mesh-f00001\.pkl: no faces; it holds vertices, uvs"):
        read_mesh(file)


def test_frames_in_the_folder_itself_are_a_sequence_of_its_name(toy_body, tmp_path):
    for i in range(4):
        write_frame(tmp_path / "mine", f"f{i}", toy_body, i)
    assert list(load_frames(tmp_path / "mine", toy_body).sequences) == ["mine"]


def test_more_coefficients_than_the_body_has_are_said(toy_body, tmp_path):
    few = load_body(toy_body.source.path, num_betas=4, num_expression=2)
    write_frame(tmp_path / "f", "a", toy_body, 1)
    with pytest.warns(CaptureNotice) as said:
        frames = load_frames(tmp_path / "f", few)
    messages = " ".join(str(w.message) for w in said)
    assert "10 betas given, the body has 4" in messages
    assert "10 expression given, the body has 2" in messages
    assert frames.params.expression.shape == (1, 2)


def test_other_names_of_parameters_are_those_of_motions(toy_body, tmp_path):
    values = frame_params(5)
    renamed = {"root_orient": values.pop("global_orient"), "pose_body": values.pop("body_pose"),
               "trans": values.pop("transl"), "expressions": values.pop("expression")}  # fmt: skip
    np.savez(tmp_path / "a.npz", shape=BETAS, **values, **renamed)
    posed_mesh(toy_body, frame_params(5)).export(tmp_path / "a.ply")
    frame = load_frames(tmp_path, toy_body)[0]
    posed = pose_body(toy_body, frame.params).vertices
    np.testing.assert_allclose(frame.vertices, posed, atol=1e-5)


def test_a_hand_alone_needs_no_body_pose(family, tmp_path):
    body = family["mano"]
    rng = np.random.default_rng(0)
    turns = {"global_orient": rng.normal(size=3), "transl": rng.normal(size=3)}
    name = next(n for n in ("right_hand_pose", "left_hand_pose") if pose_groups(body.tree)[n])
    turns |= {name: 0.3 * rng.normal(size=45)}
    posed = pose_body(body, BodyParams.create(body, **turns)).vertices
    trimesh.Trimesh(np.asarray(posed), body.faces, process=False).export(tmp_path / "a.ply")
    np.savez(tmp_path / "a.npz", betas=np.zeros(body.num_betas), **turns)
    frame = load_frames(tmp_path, body)[0]
    posed = pose_body(body, frame.params).vertices
    np.testing.assert_allclose(frame.vertices, posed, atol=1e-5)


def test_a_mesh_is_read_once_for_each_access(toy_body, tmp_path, monkeypatch):
    for i in range(3):
        write_frame(tmp_path / "f", f"f{i}", toy_body, i)
    frames, read = load_frames(tmp_path / "f", toy_body), []
    monkeypatch.setattr(
        scans_module, "read_mesh", lambda path: read.append(path.name) or read_mesh(path)
    )
    assert all(frame.part_labels is not None for frame in frames)
    assert read == ["f0.ply", "f1.ply", "f2.ply"]


@pytest.mark.parametrize("named", ["transl", "trans", None])
def test_scale_and_translation_place_the_mesh(toy_body, tmp_path, named):
    """The mesh is scale * body + translation, as data sets of scans define it."""
    values = frame_params(4)
    scale, shift = 0.44, np.array([0.1, 0.2, 0.3])
    if named is None:
        values["transl"] = np.zeros(3)
    mesh = posed_mesh(toy_body, values)
    expected = np.asarray(mesh.vertices) + shift / scale
    mesh.vertices = scale * np.asarray(mesh.vertices) + shift
    mesh.export(tmp_path / "a.ply")
    stored = {**values, "betas": BETAS, "scale": np.array([scale]), "translation": shift[None]}
    transl = stored.pop("transl")
    np.savez(tmp_path / "a.npz", **stored, **({named: transl} if named else {}))
    with pytest.warns(CaptureNotice, match=r"scales of 0.44 to 0.44; the meshes are divided by"):
        frame = load_frames(tmp_path, toy_body)[0]
    np.testing.assert_allclose(frame.vertices, expected, atol=1e-5)
    posed = pose_body(toy_body, frame.params).vertices
    np.testing.assert_allclose(frame.vertices, posed, atol=2e-5)
    np.testing.assert_array_equal(frame.part_labels, toy_body.part_labels)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": 0.0}, "scale is 0, expected a number above zero"),
        ({"scale": np.ones(3)}, r"scale has shape \(3,\), expected 1 numbers"),
        ({"scale": np.nan}, "scale is not finite"),
        ({"translation": np.zeros(2)}, r"translation has shape \(2,\), expected 3 numbers"),
        ({"scale": 0.5}, "do not belong together.*scale and translation"),
        ({"betas": np.array(["a"])}, "betas has the type <U1, expected real numbers"),
        ({"transl": np.ones(3) * 1j}, "transl has the type complex128"),
    ],
)
def test_values_that_place_nothing_are_refused(toy_body, tmp_path, changes, message):
    write_frame(tmp_path, "a", toy_body, 0, **changes)
    with pytest.raises(ValueError, match=message) as error:
        load_frames(tmp_path, toy_body)
    assert str(tmp_path / "a.") in str(error.value)


def test_ignored_entries_are_named_once(toy_body, tmp_path):
    for i in range(3):
        write_frame(tmp_path, f"f{i}", toy_body, i, focal=np.ones(2), camera=1.0, use_pca=False)
    with pytest.warns(CaptureNotice, match="ignored entries.*: camera, focal") as said:
        load_frames(tmp_path, toy_body)
    assert len(said) == 1


def test_the_gender_of_parameter_files_counts(toy_body, tmp_path):
    for i in range(2):
        write_frame(tmp_path, f"f{i}", toy_body, i, gender="female")
    with pytest.raises(ValueError, match=r"is female, but the body .* is neutral"):
        load_folder(tmp_path, toy_body)


def with_scans(prepared, subject, folder, fitted="SMPLX"):
    """A prepared subject whose sequences hold finer scans in `folder`."""
    shutil.copytree(prepared, subject)
    for registered in list(subject.glob("*/*/SMPLX")):
        (registered.parent / folder).mkdir()
        for params in registered.glob("*.pkl"):
            mesh = trimesh.load_mesh(params.with_suffix(".ply"), process=False).subdivide()
            held = {"vertices": np.asarray(mesh.vertices), "faces": np.asarray(mesh.faces)}
            name = params.stem.removesuffix("_smplx")
            (registered.parent / folder / f"{name}.pkl").write_bytes(pickle.dumps(held))
        registered.rename(registered.parent / fitted)
    return subject


@pytest.mark.parametrize(
    ("folder", "fitted"),
    [("meshes_pkl", "smplx"), ("Meshes_PKL", "SMPLX"), ("mesh-pkl", "SMPLX")],
)
def test_other_spellings_of_scans_are_read(toy_body, prepared, tmp_path, folder, fitted):
    capture = load_data(with_scans(prepared, tmp_path / "s", folder, fitted), toy_body)
    for frame in (*capture.train, *capture.test):
        assert len(frame.vertices) > 3 * toy_body.num_vertices


@pytest.mark.parametrize("folder", ["scans", "raw"])
def test_scans_that_would_be_ignored_are_an_error(toy_body, prepared, tmp_path, folder):
    subject = with_scans(prepared, tmp_path / "s", folder)
    with pytest.raises(ValueError, match=rf"{folder}: meshes that would be ignored.*meshes_pkl"):
        load_data(subject, toy_body)


def test_scans_apart_from_their_parameters_are_an_error_in_a_plain_folder(toy_body, tmp_path):
    write_frame(tmp_path / "s", "a", toy_body, 0)
    write_frame(tmp_path / "s", "b", toy_body, 1)
    (tmp_path / "s/my_scans").mkdir()
    (tmp_path / "s/my_scans/a.pkl").write_bytes(pickle.dumps({"vertices": np.zeros((3, 3))}))
    with pytest.raises(ValueError, match="my_scans: scans in a layout that is not supported"):
        load_folder(tmp_path / "s", toy_body)
    (tmp_path / "s/my_scans").rename(tmp_path / "s/cameras")
    with pytest.warns(CaptureNotice, match="cameras: 1 parameter files without meshes are ignored"):
        load_folder(tmp_path / "s", toy_body)


def test_every_kind_of_mesh_file_is_a_frame(toy_body, tmp_path):
    for i, suffix in enumerate((".ply", ".obj", ".off", ".stl", ".glb")):
        write_frame(tmp_path, f"f{i}", toy_body, i, mesh=suffix)
    frames = load_frames(tmp_path, toy_body)
    assert len(frames) == 5
    for frame in frames:
        posed = np.asarray(pose_body(toy_body, frame.params).vertices)
        np.testing.assert_allclose(np.ptp(frame.vertices, 0), np.ptp(posed, 0), atol=1e-5)
