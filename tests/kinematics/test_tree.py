"""Trees, and forward kinematics against a loop over the joints."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PARENTS, TOLERANCE, TREES, reference_relative, reference_world
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from xavatar_jax.kinematics import KinematicTree, forward_kinematics, relative_transforms


@st.composite
def trees(draw, most=9):
    count = draw(st.integers(1, most))
    parents = [-1] + [draw(st.integers(0, j - 1)) for j in range(1, count)]
    return tuple(parents)


def named(parents):
    """Made outside the strategy: type checks of tuples draw random numbers."""
    return KinematicTree(tuple(f"j{k}" for k in range(len(parents))), parents)


@pytest.mark.parametrize("kind", PARENTS)
def test_trees_of_the_family(kind):
    tree = TREES[kind]
    assert tree.parents == PARENTS[kind]
    assert tree.num_joints == len(PARENTS[kind])


def test_joint_names_of_smplx():
    names = TREES["smplx"].names
    known = {
        **{0: "pelvis", 1: "left_hip", 2: "right_hip", 4: "left_knee", 5: "right_knee"},
        **{9: "spine3", 12: "neck", 15: "head", 16: "left_shoulder", 19: "right_elbow"},
        **{20: "left_wrist", 21: "right_wrist", 22: "jaw", 23: "left_eye", 24: "right_eye"},
        **{25: "left_index1", 28: "left_middle1", 31: "left_pinky1", 34: "left_ring1"},
        **{37: "left_thumb1", 39: "left_thumb3", 40: "right_index1", 54: "right_thumb3"},
    }
    assert {k: names[k] for k in known} == known


@given(trees())
def test_levels_children_and_subtrees(parents):
    tree = named(parents)
    depth = []
    for parent in tree.parents:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    assert sorted(j for level in tree.levels for j in level) == list(range(tree.num_joints))
    for d, level in enumerate(tree.levels):
        assert all(depth[j] == d for j in level)
    for joint in range(tree.num_joints):
        expected = [k for k, parent in enumerate(parents) if parent == joint]
        assert list(tree.children(joint)) == expected

        def below(k, joint=joint):
            return k == joint or (tree.parents[k] >= 0 and below(tree.parents[k]))

        assert list(tree.subtree(joint)) == [k for k in range(tree.num_joints) if below(k)]


@settings(max_examples=6, deadline=None)
@given(trees(), st.integers(0, 2**31))
def test_forward_kinematics_agrees_with_a_loop(parents, seed):
    tree = named(parents)
    rng = np.random.default_rng(seed)
    joints = rng.normal(size=(tree.num_joints, 3))
    rotations = Rotation.from_rotvec(rng.normal(size=(tree.num_joints, 3))).as_matrix()
    with jax.enable_x64(True):
        run = jax.jit(
            lambda r, x: (forward_kinematics(tree, r, x), relative_transforms(tree, r, x))
        )
        world, relative = run(rotations, joints)
    expected = reference_world(tree.parents, rotations, joints)
    np.testing.assert_allclose(world, expected, atol=TOLERANCE["float64"])
    np.testing.assert_allclose(
        relative, reference_relative(tree.parents, rotations, joints), atol=TOLERANCE["float64"]
    )


@pytest.mark.parametrize("kind", PARENTS)
def test_identity_rotations_move_nothing(kind, rng):
    tree = TREES[kind]
    joints = jnp.asarray(rng.normal(size=(tree.num_joints, 3)), jnp.float32)
    eye = jnp.broadcast_to(jnp.eye(3), (tree.num_joints, 3, 3))
    world = jax.jit(forward_kinematics, static_argnums=0)(tree, eye, joints)
    np.testing.assert_allclose(world[:, :3, 3], joints, atol=TOLERANCE["float32"])
    relative = jax.jit(relative_transforms, static_argnums=0)(tree, eye, joints)
    expected = np.broadcast_to(np.eye(4), (tree.num_joints, 4, 4))
    np.testing.assert_allclose(relative, expected, atol=TOLERANCE["float32"])


def test_jit_vmap_and_grad(x64, rng):
    tree = TREES["smplx"]
    joints = jnp.asarray(rng.normal(size=(3, 55, 3)))
    rotations = jnp.asarray(Rotation.from_rotvec(rng.normal(size=(165, 3))).as_matrix())
    rotations = rotations.reshape(3, 55, 3, 3)
    run = jax.jit(jax.vmap(lambda r, j: relative_transforms(tree, r, j)))
    for k, found in enumerate(run(rotations, joints)):
        expected = reference_relative(tree.parents, np.asarray(rotations[k]), np.asarray(joints[k]))
        np.testing.assert_allclose(found, expected, atol=1e-11)
    check = jax.jit(lambda j: relative_transforms(tree, rotations[0], j)[:, :3, 3])
    check_grads(check, (joints[0],), order=1, modes=("fwd", "rev"))


@pytest.mark.parametrize(
    ("names", "parents", "message"),
    [
        (("a",), (-1, 0), "1 joint names but 2 parents"),
        (("a", "a"), (-1, 0), "repeat"),
        (("a", "b"), (0, -1), "first joint must be the root"),
        (("a", "b"), (-1, -1), r"joint 1 \(b\) has parent -1"),
        (("a", "b", "c"), (-1, 2, 0), r"joint 1 \(b\) has parent 2"),
        (("a", "b"), (-1, 1), r"joint 1 \(b\) has parent 1"),
        ((), (), "root"),
    ],
)
def test_wrong_trees(names, parents, message):
    with pytest.raises(ValueError, match=message):
        KinematicTree(names, parents)


def test_names_and_hash():
    tree = TREES["smplx"]
    assert tree.index("jaw") == 22
    assert tree.indices("neck", "tail", "head") == (12, 15)
    with pytest.raises(KeyError, match=r"no joint 'tail'.*pelvis"):
        tree.index("tail")
    assert hash(tree) == hash(KinematicTree(tree.names, tree.parents))
    assert tree == KinematicTree(tree.names, tree.parents)
