"""Shared by the tests: tolerances with reasons, small bodies, an analytic arm, differences."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from scipy.spatial.transform import Rotation

import xavatar_jax
from xavatar_jax.body import SMPL_TREE, SMPLH_TREE, SMPLX_TREE, mano_tree
from xavatar_jax.fields import AbstractSkinningField

# One place for tolerances. Each is absolute unless it says otherwise.
TOLERANCE = {
    "float64": 1e-12,  # a few hundred roundings of numbers of size one
    "float32": 2e-6,  # a few dozen roundings of numbers of size one
    "float32_deep": 2e-5,  # nine layers, or a chain of ten joints, of float32 roundings
    "body_m": 1e-5,  # vertices and joints in metres: the figure the project promises
    "sum_to_one": 1e-6,  # weights over 55 bones in float32: the figure the method promises
    "search_m": 1e-5,  # the search's own stopping rule, in metres
    "root_m": 5e-5,  # a root whose residual is 1e-5 m where the map shrinks by up to five
    "difference": 1e-6,  # central differences in float64 with steps of 1e-6, on functions of size 1
}

# The 55 parents as the SMPL-X files list them, typed here and not read from the library.
SMPLX_PARENTS = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15),
    *(20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38),
    *(21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53),
)
SMPLH_PARENTS = (
    *SMPLX_PARENTS[:22],
    *(20, 22, 23, 20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35),
    *(21, 37, 38, 21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50),
)
SMPL_PARENTS = (*SMPLX_PARENTS[:22], 20, 21)
MANO_PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
PARENTS = {
    "smplx": SMPLX_PARENTS,
    "smplh": SMPLH_PARENTS,
    "smpl": SMPL_PARENTS,
    "mano": MANO_PARENTS,
}
TREES = {
    "smplx": SMPLX_TREE,
    "smplh": SMPLH_TREE,
    "smpl": SMPL_TREE,
    "mano": mano_tree("right"),
}
COLUMNS = {"smplx": 400, "smplh": 16, "smpl": 10, "mano": 10, "other": 5}


def toy_arrays(
    parents: tuple[int, ...],
    *,
    columns: int = 10,
    num_vertices: int = 90,
    names: tuple[str, ...] | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """A random body of the size of a person, as the arrays of a model file: any tree."""
    rng = np.random.default_rng(seed)
    joints = len(parents)
    arrays: dict[str, Any] = {
        "v_template": rng.uniform(-0.8, 0.8, (num_vertices, 3)),
        "f": rng.permuted(np.tile(np.arange(num_vertices), (40, 1)), axis=1)[:, :3],
        "weights": rng.dirichlet(np.full(joints, 0.2), num_vertices),
        "J_regressor": rng.dirichlet(np.full(num_vertices, 0.2), joints),
        "shapedirs": 0.02 * rng.normal(size=(num_vertices, 3, columns)),
        "posedirs": 0.005 * rng.normal(size=(num_vertices, 3, 9 * (joints - 1))),
        "kintree_table": np.stack([np.array(parents), np.arange(joints)]),
    }
    if joints in (52, 55):
        for letter in "lr":
            arrays[f"hands_mean{letter}"] = 0.3 * rng.normal(size=45)
            arrays[f"hands_components{letter}"] = rng.normal(size=(45, 45))
    elif joints == 16:
        arrays["hands_mean"] = 0.3 * rng.normal(size=45)
        arrays["hands_components"] = rng.normal(size=(45, 45))
    if names is not None:
        arrays["joint2num"] = {name: k for k, name in enumerate(names)}
    return arrays


def reference_world(
    parents: tuple[int, ...], rotations: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """World transforms, one joint after another, in float64."""
    world = np.zeros((len(parents), 4, 4))
    for j, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        world[j] = local if parent < 0 else world[parent] @ local
    return world


def reference_relative(
    parents: tuple[int, ...], rotations: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """Rest-to-posed transforms: undo the rest place of the joint, then go to its world frame."""
    out = reference_world(parents, rotations, joints)
    for j in range(len(parents)):
        rest = np.eye(4)
        rest[:3, 3] = -joints[j]
        out[j] = out[j] @ rest
    return out


def reference_body(
    arrays: dict[str, Any],
    shape: np.ndarray,
    pose: np.ndarray,
    transl: np.ndarray,
    expression: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and joints of a model of the family, vertex by vertex, in float64.

    Expression columns, where there are any, start at column 300.
    """
    parents = tuple(int(p) for p in arrays["kintree_table"][0])
    parents = (-1, *parents[1:])
    directions = np.asarray(arrays["shapedirs"], np.float64)
    rest = np.asarray(arrays["v_template"], np.float64) + directions[..., : len(shape)] @ shape
    if expression is not None:
        rest = rest + directions[..., 300 : 300 + len(expression)] @ expression
    joints = np.asarray(arrays["J_regressor"], np.float64) @ rest
    rotations = Rotation.from_rotvec(pose).as_matrix()
    feature = np.concatenate([(r - np.eye(3)).ravel() for r in rotations[1:]])
    bent = rest + np.asarray(arrays["posedirs"], np.float64) @ feature
    relative = reference_relative(parents, rotations, joints)
    vertices = np.zeros_like(bent)
    for v, weights in enumerate(np.asarray(arrays["weights"], np.float64)):
        blended = sum(w * transform for w, transform in zip(weights, relative, strict=True))
        vertices[v] = (blended @ np.append(bent[v], 1.0))[:3]
    world = reference_world(parents, rotations, joints)
    return vertices + transl, world[:, :3, 3] + transl


class ArmField(AbstractSkinningField):
    """Two bones along x that meet at the origin: the weight of the second is a logistic step."""

    sharpness: jax.Array

    def __call__(self, x_c: jax.Array) -> jax.Array:
        second = jax.nn.sigmoid(self.sharpness * x_c[0])
        return jnp.stack([1 - second, second])

    def covers(self, x_c: jax.Array) -> jax.Array:
        return jnp.all(jnp.isfinite(x_c))


def arm_transforms(bend: Any, shift: Any = (0.0, 0.0, 0.0)) -> jax.Array:
    """The first bone moves by `shift`; the second also turns by `bend` about z at the origin."""
    bend = jnp.asarray(bend, dtype=float)
    c, s, o, i = jnp.cos(bend), jnp.sin(bend), jnp.zeros_like(bend), jnp.ones_like(bend)
    turn = jnp.stack([jnp.stack([c, -s, o]), jnp.stack([s, c, o]), jnp.stack([o, o, i])])
    linear = jnp.stack([jnp.eye(3, dtype=turn.dtype), turn])
    moved = jnp.broadcast_to(jnp.asarray(shift, turn.dtype), (2, 3))[..., None]
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], turn.dtype), (2, 1, 4))
    return jnp.concatenate([jnp.concatenate([linear, moved], -1), bottom], -2)


def two_bone_arm(bend: Any, sharpness: Any = 20.0) -> tuple[ArmField, jax.Array]:
    return ArmField(jnp.asarray(sharpness, dtype=float)), arm_transforms(bend)


def arm_skin(x: np.ndarray, bend: float, sharpness: float = 20.0) -> np.ndarray:
    """The arm's skinning map in plain NumPy, `(N, 3)` points."""
    x = np.asarray(x, np.float64)
    second = 1 / (1 + np.exp(-sharpness * x[:, :1]))
    turned = Rotation.from_rotvec([0, 0, bend]).apply(x)
    return (1 - second) * x + second * turned


def central_difference(
    fn: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-6
) -> np.ndarray:
    """Derivative of `fn` by every entry of `x`: output axes first, then those of `x`."""
    x = np.asarray(x, np.float64)
    columns = []
    for k in range(x.size):
        delta = np.zeros(x.size)
        delta[k] = step
        up = np.asarray(fn(x + delta.reshape(x.shape)), np.float64)
        down = np.asarray(fn(x - delta.reshape(x.shape)), np.float64)
        columns.append((up - down) / (2 * step))
    out = np.stack(columns, axis=-1)
    return out.reshape(*out.shape[:-1], *x.shape)


def all_finite(tree: Any) -> bool:
    return all(
        bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(eqx.filter(tree, eqx.is_array))
    )


def run_as_user(code: str, *arguments: Any, paths: tuple[Path, ...] = ()) -> Any:
    """What a program prints after "RESULT", in a process of its own, as users' programs run.

    There, programs are compiled with all optimisations: the tests' own shortcuts are off.
    """
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("JAX_DISABLE_MOST_OPTIMIZATIONS", "XLA_FLAGS")
    }
    source = Path(xavatar_jax.__file__).parents[1]
    found = [str(path) for path in (Path(__file__).parent, source, *paths)]
    environment |= {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(found)}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.split("RESULT", 1)[1])


@contextmanager
def refused(message):
    """A `ValueError` with this message; annotations refuse first where they are checked."""
    with pytest.raises((ValueError, TypeCheckError)) as error:
        yield
    assert error.type is TypeCheckError or re.search(message, str(error.value))
