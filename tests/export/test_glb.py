"""Rigged files, against a reader of our own, the Khronos validator, three.js and Blender."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from gltf.reader import GltfFile
from gltf.tools import blender_vertices, three_vertices, validation_report
from scipy.spatial.transform import Rotation

from xavatar_jax.export import (
    Clip,
    Rig,
    glb_bytes,
    joint_worlds,
    limit_influences,
    write_glb,
    write_sequence,
    write_weights,
)
from xavatar_jax.kinematics import KinematicTree
from xavatar_jax.meshing import Mesh

TREE = KinematicTree(("hip", "knee", "ankle", "toe", "side"), (-1, 0, 1, 2, 0))
FPS = 25.0
# A tenth of a millimetre is what a rigged file promises.
AGREES = 1e-4


def random_rotations(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return Rotation.random(int(np.prod(shape)), rng=rng).as_matrix().reshape(*shape, 3, 3)


@pytest.fixture
def rig(rng) -> Rig:
    shape = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    vertices = np.asarray(shape.vertices, np.float32)
    count = len(vertices)
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    mesh = Mesh(vertices, np.asarray(shape.faces), colors=colors).compute_normals()
    return Rig(
        mesh=mesh,
        weights=rng.dirichlet(np.full(5, 0.4), count),
        tree=TREE,
        rotations=random_rotations(rng, 5),
        translations=rng.normal(size=(5, 3)),
        targets=0.05 * rng.normal(size=(2, count, 3)),
        target_names=("smile", "frown"),
    )


@pytest.fixture
def clip(rig, rng) -> Clip:
    turns = np.cumsum(0.6 * rng.normal(size=(12, 5, 3)), axis=0)
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(12, 5, 3, 3)
    translations = np.repeat(rig.translations[None], 12, axis=0)
    translations[:, 0] += rng.normal(size=(12, 3))
    translations[:, 3] += 0.1 * rng.normal(size=(12, 3))
    return Clip("walk", FPS, rotations, translations, rng.random((12, 2)))


def posed(rig: Rig, clip: Clip, frame: int, weights: np.ndarray) -> np.ndarray:
    """Skinning vertex by vertex, joint after joint, in float64."""
    bind = chained(rig.rotations, rig.translations)
    now = chained(clip.rotations[frame], clip.translations[frame])
    moves = [a @ np.linalg.inv(b) for a, b in zip(now, bind, strict=True)]
    points = rig.mesh.vertices + np.tensordot(clip.coefficients[frame], rig.targets, 1)
    return np.stack(
        [
            sum(w * (m @ np.append(p, 1))[:3] for w, m in zip(row, moves, strict=True))
            for p, row in zip(points, weights, strict=True)
        ]
    )


def chained(rotations: np.ndarray, translations: np.ndarray) -> list[np.ndarray]:
    world: list[np.ndarray] = []
    for joint, parent in enumerate(TREE.parents):
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = rotations[joint], translations[joint]
        world.append(local if parent < 0 else world[parent] @ local)
    return world


def heaviest(weights: np.ndarray, count: int) -> np.ndarray:
    """All but the heaviest `count` entries of each row removed, row by row."""
    out = np.zeros_like(weights)
    for row, kept in zip(weights, out, strict=True):
        for joint in sorted(range(len(row)), key=lambda j: -row[j])[:count]:
            kept[joint] = row[joint]
    return out / out.sum(1, keepdims=True)


@pytest.mark.parametrize("influences", [4, 8])
def test_reading_and_skinning_gives_the_pose(rig, clip, influences, tmp_path):
    write_glb(tmp_path / "a.glb", rig, [clip], influences=influences)
    file = GltfFile(tmp_path / "a.glb")
    weights = heaviest(rig.weights, influences)
    np.testing.assert_allclose(file.weights(), weights, atol=1e-6)
    for frame in (0, 5, 11):
        expected = posed(rig, clip, frame, weights)
        assert np.abs(file.posed(frame / FPS) - expected).max() < 1e-5
    # Without a clip the nodes stand in the bind pose, where the mesh is as it was given.
    assert np.abs(file.posed() - rig.mesh.vertices).max() < 1e-5


def test_read_only_arrays_are_written_too(rig, clip, tmp_path):
    for array in (rig.rotations, rig.translations, clip.rotations, clip.translations):
        array.flags.writeable = False
    write_glb(tmp_path / "a.glb", rig, [clip])
    expected = posed(rig, clip, 4, heaviest(rig.weights, 4))
    assert np.abs(GltfFile(tmp_path / "a.glb").posed(4 / FPS) - expected).max() < 1e-5


def test_worlds_are_chained(rig, clip):
    worlds = joint_worlds(TREE, clip.rotations, clip.translations)
    np.testing.assert_allclose(worlds[3], chained(clip.rotations[3], clip.translations[3]))
    np.testing.assert_allclose(rig.bind, chained(rig.rotations, rig.translations))


def test_between_frames_rotations_take_the_short_way(rig, clip, tmp_path):
    write_glb(tmp_path / "a.glb", rig, [clip])
    file = GltfFile(tmp_path / "a.glb")
    for channel in file.json["animations"][0]["channels"]:
        if channel["target"]["path"] == "rotation":
            number = file.json["animations"][0]["samplers"][channel["sampler"]]["output"]
            values = file.accessor(number)
            assert ((values[1:] * values[:-1]).sum(1) >= 0).all()


def test_everything_of_the_mesh_is_there(rig, clip, tmp_path):
    write_glb(tmp_path / "a.glb", rig, [clip, replace(clip, name="again", fps=30.0)])
    file = GltfFile(tmp_path / "a.glb")
    np.testing.assert_array_equal(file.faces, rig.mesh.faces)
    np.testing.assert_allclose(file.attribute("POSITION"), rig.mesh.vertices)
    np.testing.assert_allclose(file.attribute("NORMAL"), rig.mesh.normals, atol=1e-6)
    np.testing.assert_allclose(file.targets(), rig.targets, atol=1e-7)
    assert file.mesh["extras"]["targetNames"] == ["smile", "frown"]
    assert [a["name"] for a in file.json["animations"]] == ["walk", "again"]
    names = [file.json["nodes"][j]["name"] for j in file.skin["joints"]]
    assert tuple(names) == TREE.names
    # sRGB 188 is linear light of one half (to 8 bits); 0 and 255 are fixed.
    curve = {0: 0.0, 188: 0.5029, 255: 1.0}
    stored = file.attribute("COLOR_0")[:, :3] / 65535
    for value, linear in curve.items():
        found = stored[rig.mesh.colors == value]
        assert len(found)
        np.testing.assert_allclose(found, linear, atol=1e-4)


def test_another_library_reads_it(rig, clip, tmp_path):
    write_glb(tmp_path / "a.glb", rig, [clip])
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.vertices, rig.mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, rig.mesh.faces)


def test_a_clip_of_one_frame_and_a_file_without_clip(rig, clip, tmp_path):
    single = Clip("one", FPS, clip.rotations[:1], clip.translations[:1], clip.coefficients[:1])
    write_glb(tmp_path / "one.glb", rig, [single])
    file = GltfFile(tmp_path / "one.glb")
    expected = posed(rig, single, 0, heaviest(rig.weights, 4))
    assert np.abs(file.posed(0.0) - expected).max() < 1e-5
    write_glb(tmp_path / "none.glb", rig)
    assert "animations" not in GltfFile(tmp_path / "none.glb").json


def test_more_vertices_than_sixteen_bits_count(rig, tmp_path):
    count = 66_000
    vertices = np.zeros((count, 3), np.float32)
    vertices[-3:] = np.eye(3)
    many = Rig(
        mesh=Mesh(vertices, np.asarray([[count - 3, count - 2, count - 1]])),
        weights=np.eye(5)[np.zeros(count, int)],
        tree=TREE,
        rotations=rig.rotations,
        translations=rig.translations,
        targets=np.zeros((0, count, 3)),
        target_names=(),
    )
    write_glb(tmp_path / "many.glb", many)
    assert GltfFile(tmp_path / "many.glb").faces.tolist() == [[count - 3, count - 2, count - 1]]


def bare(rig: Rig) -> Rig:
    return replace(
        rig,
        mesh=Mesh(rig.mesh.vertices, rig.mesh.faces),
        targets=rig.targets[:0],
        target_names=(),
    )


@pytest.mark.parametrize("influences", [4, 8])
@pytest.mark.parametrize("kind", ["everything", "bare", "one frame"])
def test_the_khronos_validator_finds_nothing(rig, clip, influences, kind, tmp_path):
    if kind == "bare":
        rig, clips = bare(rig), []
    elif kind == "one frame":
        clips = [Clip("one", FPS, clip.rotations[:1], clip.translations[:1], np.ones((1, 2)))]
    else:
        clips = [clip, replace(clip, name="again")]
    path = tmp_path / "a.glb"
    write_glb(path, rig, clips, influences=influences)
    issues = validation_report(path)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_three_js_agrees(rig, clip, tmp_path):
    path = tmp_path / "a.glb"
    write_glb(path, rig, [clip])
    frames = [0, 4, 11]
    found, counts = three_vertices(path, FPS, frames)
    assert counts["clips"] == ["walk"]
    assert counts["targets"] == ["smile", "frown"]
    for k, frame in enumerate(frames):
        expected = posed(rig, clip, frame, heaviest(rig.weights, 4))
        assert np.abs(found[k] - expected).max() < AGREES


def test_blender_agrees(rig, clip, tmp_path):
    path = tmp_path / "a.glb"
    write_glb(path, rig, [clip], influences=8)
    frames = [0, 4, 11]
    found, names = blender_vertices(path, FPS, frames)
    assert set(names["bones"]) == set(TREE.names)
    assert {"smile", "frown"} <= set(names["shapes"])
    for k, frame in enumerate(frames):
        expected = posed(rig, clip, frame, heaviest(rig.weights, 8))
        assert np.abs(found[k] - expected).max() < AGREES


def test_influences_are_the_heaviest(rng):
    weights = rng.dirichlet(np.full(9, 0.3), 50)
    weights[0] = 0
    weights[0, 7] = 1
    limited = limit_influences(weights, 4)
    assert limited.joints[0].tolist() == [7, 0, 0, 0]
    assert limited.weights[0].tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(limited.dense(9), heaviest(weights, 4), atol=1e-6)
    np.testing.assert_allclose(limited.weights.sum(1), 1, atol=2e-7)
    assert (np.diff(limited.weights, axis=1) <= 0).all()
    with pytest.raises(ValueError, match="vertex 3"):
        limit_influences(np.where(np.arange(50)[:, None] == 3, 0, weights), 4)


def test_misfits_are_named(rig, clip):
    with pytest.raises(ValueError, match=r"rig: weights has shape \(162, 4\), expected \(162, 5\)"):
        replace(rig, weights=rig.weights[:, :4])
    with pytest.raises(ValueError, match="clip 'walk': translations has shape"):
        replace(clip, translations=clip.translations[:3])
    with pytest.raises(ValueError, match="frame rate -30"):
        replace(clip, fps=-30.0)
    with pytest.raises(ValueError, match="no frames"):
        Clip("walk", FPS, np.zeros((0, 5, 3, 3)), np.zeros((0, 5, 3)), np.zeros((0, 2)))
    with pytest.raises(ValueError, match="coefficients are not finite"):
        replace(clip, coefficients=np.full((12, 2), np.nan))
    with pytest.raises(ValueError, match="the rig"):
        glb_bytes(rig, [replace(clip, coefficients=np.zeros((12, 3)))])
    with pytest.raises(ValueError, match="same name"):
        glb_bytes(rig, [clip, clip])
    with pytest.raises(ValueError, match="4 or 8"):
        glb_bytes(rig, influences=5)  # pyright: ignore[reportArgumentType]


def test_paths_that_cannot_be_written(rig, tmp_path):
    with pytest.raises(ValueError, match=r"a\.gltf: binary glTF"):
        write_glb(tmp_path / "a.gltf", rig)
    (tmp_path / "file").write_text("here")
    with pytest.raises(OSError, match="file"):
        write_glb(tmp_path / "file" / "a.glb", rig)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_weights_file_needs_no_pickle(rig, tmp_path):
    write_weights(tmp_path / "w.npz", rig)
    with np.load(tmp_path / "w.npz", allow_pickle=False) as file:
        read = dict(file)
    assert tuple(read["joint_names"].tolist()) == TREE.names
    assert tuple(read["parents"].tolist()) == TREE.parents
    np.testing.assert_allclose(read["weights"], rig.weights, atol=1e-7)
    world = chained(rig.rotations, rig.translations)
    np.testing.assert_allclose(read["bind_transforms"], world, atol=1e-6)
    np.testing.assert_allclose(read["rest_joints"], np.stack(world)[:, :3, 3], atol=1e-6)


@pytest.mark.parametrize("format", ["ply", "obj"])
def test_sequences_keep_vertices_and_faces(rig, format, tmp_path):
    meshes = [replace(rig.mesh, vertices=rig.mesh.vertices + k) for k in range(3)]
    done: list[int] = []
    paths = write_sequence(tmp_path / "s", iter(meshes), 3, format=format, done=done.append)
    assert done == [1, 1, 1]
    assert sorted(p.name for p in (tmp_path / "s").iterdir()) == [
        f"frame_000{k}.{format}" for k in range(3)
    ]
    for mesh, path in zip(meshes, paths, strict=True):
        read = trimesh.load(path, process=False, maintain_order=True)
        np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-5)
        np.testing.assert_array_equal(read.faces, mesh.faces)


def test_an_interrupted_sequence_leaves_nothing(rig, tmp_path):
    def meshes():
        yield rig.mesh
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sequence(tmp_path / "s", meshes(), 2)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "s").mkdir()
    with pytest.raises(FileExistsError, match="name a new folder"):
        write_sequence(tmp_path / "s", meshes(), 2)
    with pytest.raises(ValueError, match="unknown format 'stl': ply, obj"):
        write_sequence(tmp_path / "t", meshes(), 2, format="stl")  # pyright: ignore
