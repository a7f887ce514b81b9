"""A mesh on a skeleton, its motions, and its skinning weights as stored in files."""

import os
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..files import atomic_path
from ..kinematics import KinematicTree
from ..meshing import Mesh


@dataclass(frozen=True, eq=False)
class Rig:
    """A mesh in its bind pose on a joint tree, with blend shapes. Metres, y up.

    - `mesh`: vertices in the bind pose, with optional normals and colours.
    - `weights`: skinning weights (V, J), rows sum to one.
    - `rotations`, `translations`: joint rotations (J, 3, 3) relative to the parent and positions
      (J, 3) in the parent's frame, in the bind pose.
    - `targets`: blend shapes as displacements of the vertices before skinning (E, V, 3).

    **Raises:** `ValueError` naming an array of the wrong shape.
    """

    mesh: Mesh
    # Sizes "_" are checked in `__post_init__`, whose message names the array.
    weights: Float[np.ndarray, "_ _"]
    tree: KinematicTree
    rotations: Float[np.ndarray, "_ 3 3"]
    translations: Float[np.ndarray, "_ 3"]
    targets: Float[np.ndarray, "_ _ 3"]
    target_names: tuple[str, ...]

    def __post_init__(self) -> None:
        joints, vertices = self.tree.num_joints, self.mesh.num_vertices
        shapes = {
            "weights": (vertices, joints),
            "rotations": (joints, 3, 3),
            "translations": (joints, 3),
            "targets": (len(self.target_names), vertices, 3),
        }
        _check_shapes("rig", self, shapes)

    @property
    def bind(self) -> Float[np.ndarray, "J 4 4"]:
        """World transform of every joint in the bind pose, float64."""
        return joint_worlds(self.tree, self.rotations[None], self.translations[None])[0]


@dataclass(frozen=True, eq=False)
class Clip:
    """One motion of a rig, listed under its name by other programs. Metres, y up.

    - `fps`: frames per second; the first frame is at time 0.
    - `rotations`, `translations`: joint rotations (T, J, 3, 3) relative to the parent and positions
      (T, J, 3) in the parent's frame.
    - `coefficients`: blend shape weights (T, E).

    **Raises:** `ValueError` if frame counts differ, there is no frame, or a value is not finite.
    """

    name: str
    fps: float
    rotations: Float[np.ndarray, "_ _ 3 3"]
    translations: Float[np.ndarray, "_ _ 3"]
    coefficients: Float[np.ndarray, "_ _"]

    def __post_init__(self) -> None:
        frames, joints = np.shape(self.rotations)[:2]
        shapes = {
            "rotations": (frames, joints, 3, 3),
            "translations": (frames, joints, 3),
            "coefficients": (frames, *np.shape(self.coefficients)[1:]),
        }
        _check_shapes(f"clip {self.name!r}", self, shapes)
        if frames == 0:
            raise ValueError(f"clip {self.name!r} has no frames")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"clip {self.name!r}: frame rate {self.fps}; it must be positive")
        for name in shapes:
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"clip {self.name!r}: {name} are not finite")

    def __len__(self) -> int:
        return len(self.rotations)


def joint_worlds(
    tree: KinematicTree,
    rotations: Float[np.ndarray, "T J 3 3"],
    translations: Float[np.ndarray, "T J 3"],
) -> Float[np.ndarray, "T J 4 4"]:
    """World transforms of all joints in float64, chained as in programs that read the file."""
    local = np.zeros((*np.shape(rotations)[:2], 4, 4))
    local[..., :3, :3], local[..., :3, 3], local[..., 3, 3] = rotations, translations, 1
    world = local.copy()
    for joint, parent in enumerate(tree.parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def rotation_quaternions(matrices: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T J 4"]:
    """Unit quaternions (x, y, z, w) with the sign that is closer to the previous frame."""
    from scipy.spatial.transform import Rotation

    matrices = np.array(matrices, np.float64)  # SciPy refuses read-only arrays
    quaternions = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat()
    quaternions = quaternions.reshape(*matrices.shape[:2], 4)
    turned = (quaternions[1:] * quaternions[:-1]).sum(-1) < 0
    sign = np.where(np.cumsum(turned, axis=0) % 2 == 1, -1.0, 1.0)
    quaternions[1:] *= sign[..., None]
    return quaternions.astype(np.float32)


class Influences(NamedTuple):
    """The bones of each vertex `(V, k)`, heaviest first, and their weights `(V, k)`, float32.

    Weights sum to one in each row; entries of weight zero name bone 0.
    """

    joints: Int[np.ndarray, "V k"]
    weights: Float[np.ndarray, "V k"]

    def dense(self, num_joints: int) -> Float[np.ndarray, "V J"]:
        """The same weights as a dense matrix over all bones."""
        full = np.zeros((len(self.joints), num_joints), np.float32)
        # Add, because entries of weight zero may name bone 0 a second time.
        np.add.at(full, (np.arange(len(full))[:, None], self.joints), self.weights)
        return full


def limit_influences(weights: Float[np.ndarray, "V J"], count: int) -> Influences:
    """The `count` heaviest bones of each vertex, with weights scaled to sum to one.

    Entries are zero if there are fewer bones, or for weights below a millionth of the largest.

    **Raises:** `ValueError` if a vertex has no positive weight, or `count` is less than one.
    """
    if count < 1:
        raise ValueError(f"{count} influences; at least one is needed")
    weights = np.asarray(weights, np.float64)
    kept = min(count, weights.shape[1])
    joints = np.argpartition(-weights, kept - 1, axis=1)[:, :kept]
    chosen = np.take_along_axis(weights, joints, axis=1)
    order = np.argsort(-chosen, axis=1, kind="stable")
    joints = np.take_along_axis(joints, order, axis=1)
    chosen = np.take_along_axis(chosen, order, axis=1)
    if not (chosen[:, 0] > 0).all():
        vertex = int(np.flatnonzero(~(chosen[:, 0] > 0))[0])
        raise ValueError(f"skinning weights of vertex {vertex} are not positive: no bone moves it")
    chosen = np.where(chosen < 1e-6 * chosen[:, :1], 0.0, chosen)
    chosen = (chosen / chosen.sum(1, keepdims=True)).astype(np.float32)
    joints = np.where(chosen > 0, joints, 0)
    missing = ((0, 0), (0, count - kept))
    return Influences(np.pad(joints, missing), np.pad(chosen, missing))


def write_weights(path: str | os.PathLike[str], rig: Rig) -> None:
    """Write the skinning of a rig to an `.npz` without pickles: metres, y up.

    Entries: `weights` (V, J), `vertices` (V, 3) and `faces` (F, 3) of the bind pose,
    `joint_names` (J,), `parents` (J,) with -1 for the root, `rest_joints` (J, 3) in the world of
    the bind pose, `bind_transforms` (J, 4, 4) from joint frames to that world.

    **Raises:** `OSError` if the file cannot be written; an existing file stays unchanged.
    """
    bind = rig.bind
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file,
            weights=rig.weights.astype(np.float32),
            vertices=rig.mesh.vertices.astype(np.float32),
            faces=rig.mesh.faces.astype(np.int32),
            joint_names=np.asarray(rig.tree.names, dtype=np.str_),
            parents=np.asarray(rig.tree.parents, np.int32),
            rest_joints=bind[:, :3, 3].astype(np.float32),
            bind_transforms=bind.astype(np.float32),
        )


def _check_shapes(what: str, owner: object, shapes: dict[str, tuple[int, ...]]) -> None:
    for name, expected in shapes.items():
        found = np.shape(getattr(owner, name))
        if found != expected:
            raise ValueError(f"{what}: {name} has shape {found}, expected {expected}")
