"""A mesh on a skeleton and its motions, as files with a rig hold them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..kinematics import KinematicTree
from ..meshing import Mesh


@dataclass(frozen=True, eq=False)
class Rig:
    """A mesh in its bind pose on a tree of joints, with blend shapes. Metres, y up.

    Attributes:
        mesh: vertices in the bind pose; normals and colours are written if it has them.
        weights: skinning weights (V, J), rows sum to one.
        tree: names and parents of the J joints.
        rotations: of every joint relative to its parent in the bind pose (J, 3, 3).
        translations: of every joint relative to its parent's frame in the bind pose (J, 3).
        targets: displacements of the vertices (E, V, 3), one blend shape a coefficient; they act
            before skinning.
        target_names: E names.

    Raises:
        ValueError: if shapes do not fit each other; the message names the array.
    """

    mesh: Mesh
    weights: Float[np.ndarray, "V J"]
    tree: KinematicTree
    rotations: Float[np.ndarray, "J 3 3"]
    translations: Float[np.ndarray, "J 3"]
    targets: Float[np.ndarray, "E V 3"]
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
    """One motion of a rig. Metres, y up.

    Attributes:
        name: what programs list it under.
        fps: frames a second; the first frame is at time 0.
        rotations: of every joint relative to its parent (T, J, 3, 3).
        translations: of every joint relative to its parent's frame (T, J, 3).
        coefficients: of the blend shapes (T, E).

    Raises:
        ValueError: if frame counts differ or there is no frame, or a value is not finite.
    """

    name: str
    fps: float
    rotations: Float[np.ndarray, "T J 3 3"]
    translations: Float[np.ndarray, "T J 3"]
    coefficients: Float[np.ndarray, "T E"]

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
    """World transforms of all joints, as a program that reads the file chains them; float64."""
    local = np.zeros((*np.shape(rotations)[:2], 4, 4))
    local[..., :3, :3], local[..., :3, 3], local[..., 3, 3] = rotations, translations, 1
    world = local.copy()
    for joint, parent in enumerate(tree.parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def rotation_quaternions(matrices: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T J 4"]:
    """Unit quaternions, x y z w, of which each is the nearer of the two to the frame before."""
    from scipy.spatial.transform import Rotation

    matrices = np.array(matrices, np.float64)  # SciPy refuses read-only arrays
    quaternions = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat()
    quaternions = quaternions.reshape(*matrices.shape[:2], 4)
    turned = (quaternions[1:] * quaternions[:-1]).sum(-1) < 0
    sign = np.where(np.cumsum(turned, axis=0) % 2 == 1, -1.0, 1.0)
    quaternions[1:] *= sign[..., None]
    return quaternions.astype(np.float32)


def _check_shapes(what: str, owner: object, shapes: dict[str, tuple[int, ...]]) -> None:
    for name, expected in shapes.items():
        found = np.shape(getattr(owner, name))
        if found != expected:
            raise ValueError(f"{what}: {name} has shape {found}, expected {expected}")
