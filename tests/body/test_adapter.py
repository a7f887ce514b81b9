"""Bodies and poses of the package `body-models`, beside that package's own posing."""

from __future__ import annotations

from enum import Enum
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xavatar_jax.body import (
    BodyParams,
    body_from_model,
    load_body,
    params_from_model,
    pose_body,
    rest_joints,
)
from xavatar_jax.files import load_npz

PARTS_OF_SMPLX = {"body_pose": 21, "head_pose": 3, "hand_pose": 30}


@pytest.fixture(scope="module")
def smplx(bundled_body, tmp_path_factory):
    """The bundled body without pose correctives, in the package's SMPL-X."""
    package = pytest.importorskip("body_models.smplx.numpy", reason="needs the package body-models")
    arrays = dict(load_npz(bundled_body.source.path))
    arrays["posedirs"] = np.zeros_like(arrays["posedirs"])
    path = tmp_path_factory.mktemp("smplx") / "SMPLX_NEUTRAL.npz"
    np.savez(path, **arrays)
    return package.SMPLX(model_path=path, flat_hand_mean=True)


def test_smplx_is_posed_as_the_package_poses_it(smplx, rng):
    identity = {"shape": rng.normal(size=10), "expression": rng.normal(size=10)}
    body = body_from_model(smplx, identity=identity)
    pose = {name: 0.3 * rng.normal(size=(3, n, 3)) for name, n in PARTS_OF_SMPLX.items()}
    moved = {"global_rotation": rng.normal(size=(3, 3)), "global_translation": rng.normal(size=3)}
    moved["pelvis_rotation"] = rng.normal(size=(3, 3))
    params = params_from_model(smplx, body, {**pose, **moved}, identity=identity)
    found = jax.vmap(pose_body, in_axes=(None, 0))(body, params)
    person = {n: np.broadcast_to(v, (3, 10)).astype(np.float32) for n, v in identity.items()}
    given = {n: np.asarray(v, np.float32) for n, v in {**pose, **moved}.items()}
    given["global_translation"] = np.broadcast_to(given["global_translation"], (3, 3))
    expected = smplx.forward_vertices(**given, **person)
    np.testing.assert_allclose(found.vertices, expected, atol=5e-5)
    skeleton = smplx.forward_skeleton(**given, **person)
    np.testing.assert_allclose(found.joints, skeleton[..., :3, 3], atol=5e-5)


def test_names_give_the_parts_of_smplx(smplx, bundled_body):
    body = body_from_model(smplx)
    assert set(body.tree.names) == set(bundled_body.tree.names)
    labels = load_body(bundled_body.source.path).part_labels
    assert (np.isin(body.part_labels, (2, 3)) == np.isin(labels, (2, 3))).mean() > 0.95


class Common(Enum):
    INDEX = "left_index_mcp"


class Arm:
    """Four joints in an order of their own, bone frames that are turned, a name for one."""

    joint_names = ("tip", "base", "mid", "elbow.L")
    runtime = SimpleNamespace(asarray=lambda value, like: np.asarray(value, np.float64))

    def __init__(self):
        self.parents = (2, -1, 3, 1)
        self.common_joints = {Common.INDEX: "elbow.L"}
        self.parameter_spec = {
            "size": SimpleNamespace(role="identity", dims=(1,)),
            "turn": SimpleNamespace(role="pose", dims=(4, 3)),
            "stretch": SimpleNamespace(role="pose", dims=()),
            "shift": SimpleNamespace(role="transform", dims=(3,)),
        }
        rng = np.random.default_rng(1)
        self.rest_vertices = rng.uniform([0, -0.1, -0.1], [1, 0.1, 0.1], (90, 3))
        self.places = np.array([[0.9, 0, 0], [0, 0, 0], [0.6, 0, 0], [0.3, 0, 0]])
        self.frames = Rotation.from_rotvec(rng.normal(size=(4, 3))).as_matrix()
        weights = np.exp(-20 * np.abs(self.rest_vertices[:, :1] - self.places[:, 0]))
        weights /= weights.sum(1, keepdims=True)
        triangles = rng.integers(0, 90, (60, 3))
        self.skinning_spec = SimpleNamespace(skinning_weights=weights, triangles=triangles)

    def get_rest_pose(self):
        return {
            "size": np.ones(1), "turn": np.zeros((4, 3)), "stretch": np.zeros(()),
            "shift": np.zeros(3),
        }  # fmt: skip

    def bind(self, size):
        frames = np.broadcast_to(np.eye(4), (4, 4, 4)).copy()
        frames[:, :3, :3] = self.frames
        frames[:, :3, 3] = size[0] * self.places
        return frames

    def prepare_identity(self, size):
        return {"rest_vertices": size[0] * self.rest_vertices, "size": size}

    def prepare_pose(self, turn, stretch, *, identity):
        size = identity["size"]
        posed = self.forward_skeleton(turn, stretch, np.zeros(3), size)
        return {"skinning_transforms": posed @ np.linalg.inv(self.bind(size))}

    def forward_skeleton(self, turn, stretch, shift, size):
        if turn.ndim > 2:
            frames = zip(turn, stretch, shift, size, strict=True)
            return np.stack([self.forward_skeleton(*frame) for frame in frames])
        bind, world = self.bind(size), {}
        for joint in (1, 3, 2, 0):
            parent = self.parents[joint]
            at_rest = bind[joint] if parent < 0 else np.linalg.inv(bind[parent]) @ bind[joint]
            own = np.eye(4)
            own[:3, :3] = Rotation.from_rotvec(turn[joint]).as_matrix()
            own[0, 3] = stretch * (joint == 2)
            world[joint] = (np.eye(4) if parent < 0 else world[parent]) @ at_rest @ own
            if parent < 0:
                world[joint][:3, 3] += shift
        return np.stack([world[j] for j in range(4)])

    def forward_vertices(self, turn, stretch, shift, size):
        posed = self.forward_skeleton(turn, stretch, shift, size) @ np.linalg.inv(self.bind(size))
        points = np.concatenate([size[0] * self.rest_vertices, np.ones((90, 1))], 1)
        return np.einsum("vj,jab,vb->va", self.skinning_spec.skinning_weights, posed, points)[:, :3]


def test_another_tree_is_posed_as_its_model_poses_it(rng):
    arm, identity = Arm(), {"size": np.array([1.3])}
    body = body_from_model(arm, identity=identity, names={"base": "left_wrist"})
    assert body.tree.names == ("left_wrist", "left_index1", "mid", "tip")
    assert body.tree.parents == (-1, 0, 1, 2)
    assert (body.part_labels == 2).all()  # all hangs from the left wrist
    turn, shift = 0.6 * rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 3))
    params = params_from_model(arm, body, {"turn": turn, "shift": shift}, identity=identity)
    found = jax.vmap(pose_body, in_axes=(None, 0))(body, params).vertices
    for k in range(5):
        expected = arm.forward_vertices(turn[k], 0.0, shift[k], identity["size"])
        np.testing.assert_allclose(found[k], expected, atol=1e-5)


def test_joints_can_be_regressed_from_the_template():
    body = body_from_model(Arm())
    regressed = np.asarray(body.joint_regressor) @ np.asarray(body.template)
    np.testing.assert_allclose(regressed, rest_joints(body, np.zeros(0)), atol=1e-6)
    np.testing.assert_allclose(np.asarray(body.joint_regressor).sum(1), 1, atol=1e-6)
    assert BodyParams.zeros(body).betas.shape == (0,)


def test_what_does_not_fit_is_named(smplx):
    arm = Arm()
    body = body_from_model(arm)
    with pytest.raises(ValueError, match=r"moves mid by 200\.0 mm along its bone"):
        params_from_model(arm, body, {"stretch": np.array(0.2)})
    with pytest.raises(ValueError, match=r"parameters has bend; the model takes shift, stretch"):
        params_from_model(arm, body, {"bend": 0})
    with pytest.raises(ValueError, match=r"identity has turn; the model takes size"):
        body_from_model(arm, identity={"turn": 0})
    with pytest.raises(ValueError, match=r"names has knee, which are not joints of the model"):
        body_from_model(arm, names={"knee": "left_knee"})
    with pytest.raises(ValueError, match=r"the model has .* vertices and 55 joints.*90 and 4"):
        params_from_model(smplx, body, {})
    arm.parents = (2, -1, -1, 1)
    with pytest.raises(ValueError, match="2 root joints, expected one"):
        body_from_model(arm)


def test_missing_files_name_the_command_that_fetches_them(monkeypatch):
    package = pytest.importorskip("body_models", reason="needs the package body-models")

    def offline(*_, **__):
        raise OSError("no route to host")

    monkeypatch.setattr(package, "create_model", offline)
    with pytest.raises(FileNotFoundError, match=r"no route.*`body-models download anny`"):
        body_from_model("anny")
