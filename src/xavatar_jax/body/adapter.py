"""Convert bodies of the package `body-models` (ANNY, MHR, the SMPL family)."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..kinematics import KinematicTree, matrix_to_axis_angle
from .model import BodyModel, BodySource, body_checksum, make_body
from .params import BodyParams
from .parts import derive_part_labels, standard_parts

_PHALANGES = {"mcp": 1, "pip": 2, "dip": 3}
_THUMB = {"cmc": 1, "mcp": 2, "ip": 3}
# Joints missing from the package's common vocabulary, by the names in its models.
_MORE_NAMES = {"jaw": "jaw", "eye.L": "left_eye", "eye.R": "right_eye"}
_RIGID_M = 1e-3  # largest change of a bone's length
_REGRESSED_FROM = 64  # number of vertices that a joint is regressed from


def body_from_model(
    model: Any,
    *,
    identity: Mapping[str, Any] | None = None,
    names: Mapping[str, str] | None = None,
) -> BodyModel:
    """A body with the mesh, tree and skinning weights of a model of the package `body-models`.

    The result has no shape or expression coefficients and no pose correctives (an avatar learns
    them). Joints known to the package get SMPL-X's names, from which parts and starts are found.

    - `model`: a `body_models.SkinnedModel`, or a name for `body_models.create_model` ("anny").
    - `identity`: the model's parameters of the person's shape. Default: its rest values.
    - `names`: more joint names, from the model's to SMPL-X's.

    **Raises:** `FileNotFoundError` with the command that downloads the model's files;
    `ValueError` for unknown identity parameters or repeated joint names.
    """
    model = _create(model) if isinstance(model, str) else model
    vertices, bind = _rest(model, identity)
    order = _parents_first(model.parents)
    place = {joint: k for k, joint in enumerate(order)}
    parents = tuple(place.get(int(model.parents[j]), -1) for j in order)
    known = _known_names(model, names or {})
    native = [str(name) for name in model.joint_names]
    tree = KinematicTree(tuple(known.get(native[j], native[j]) for j in order), parents)
    joints = bind[list(order), :3, 3]
    weights = np.asarray(model.skinning_spec.skinning_weights, np.float64)[:, list(order)]
    faces = np.asarray(model.skinning_spec.triangles, np.int32)
    return make_body(
        template=vertices,
        faces=faces,
        joint_regressor=_regressor(joints, vertices),
        joints=joints,
        weights=weights / weights.sum(1, keepdims=True),
        parts=standard_parts(tree, derive_part_labels(tree, weights)),
        tree=tree,
        source=BodySource(
            path=f"body-models:{type(model).__name__}",
            kind="other",
            gender=str(getattr(model, "gender", "neutral")),
            checksum=body_checksum(tree, faces, vertices, weights, joints),
        ),
    )


def params_from_model(
    model: Any,
    body: BodyModel,
    parameters: Mapping[str, Any],
    *,
    identity: Mapping[str, Any] | None = None,
) -> BodyParams:
    """Convert pose parameters of a model to those of `body_from_model(model, identity=identity)`.

    `parameters` are arguments of the model's `forward_vertices` other than its identity, for one
    frame or a batch; the others keep their rest values.

    **Raises:** `ValueError` for unknown parameters, for another model's body, or naming the joint
    where a pose stretches a bone, which rotations cannot express.
    """
    vertices, bind = _rest(model, identity)
    if vertices.shape != body.template.shape or len(bind) != body.num_joints:
        raise ValueError(
            f"the model has {len(vertices)} vertices and {len(bind)} joints, the body "
            f"({body.source.describe()}) has {body.num_vertices} and {body.num_joints}: pass the "
            "body that body_from_model made of this model"
        )
    known = {name for name, spec in model.parameter_spec.items() if spec.role != "identity"}
    _only_known("parameters", parameters, known)
    whole = {**_at_rest(model, identity), **parameters}
    leading = {n: np.ndim(v) - len(model.parameter_spec[n].dims) for n, v in whole.items()}
    # Rest values are broadcast to the batch of the given parameters.
    batch = np.broadcast_shapes(*(np.shape(v)[: leading[n]] for n, v in whole.items()))
    whole = {n: np.broadcast_to(v, (*batch, *np.shape(v)[leading[n] :])) for n, v in whole.items()}
    order = list(_parents_first(model.parents))
    posed = np.asarray(model.forward_skeleton(**_typed(model, whole)), np.float64)
    carried = (posed @ np.linalg.inv(bind))[..., order, :, :]
    turned = carried[..., :3, :3]
    parents = np.asarray(body.tree.parents)
    local = turned.copy()
    local[..., 1:, :, :] = (
        np.swapaxes(turned[..., parents[1:], :, :], -1, -2) @ turned[..., 1:, :, :]
    )
    joints = bind[order, :3, 3]
    reached = (turned @ joints[..., None])[..., 0] + carried[..., :3, 3]
    pose = matrix_to_axis_angle(jnp.asarray(local))
    transl = reached[..., 0, :] - joints[0]
    _check_rigid(body, turned, joints, reached)
    return BodyParams.create(body, pose=pose, transl=transl)


def _create(name: str) -> Any:
    try:
        import body_models
    except ImportError as error:
        raise ImportError(
            "bodies of other projects need the package body-models: "
            'pip install "xavatar-jax[bodies]"'
        ) from error
    try:
        return body_models.create_model(name, runtime="numpy")
    except ValueError:
        raise
    except Exception as error:  # the package downloads missing files; any network error may occur
        raise FileNotFoundError(
            f"the files of {name} are missing ({error}); `body-models download {name}` "
            "downloads them"
        ) from error


def _at_rest(model: Any, identity: Mapping[str, Any] | None) -> dict[str, np.ndarray]:
    """All parameters of one frame: rest values and the given identity."""
    specs = model.parameter_spec
    of_person = {name for name, spec in specs.items() if spec.role == "identity"}
    _only_known("identity", identity or {}, of_person)
    rest = {name: np.asarray(value) for name, value in model.get_rest_pose().items()}
    return {**rest, **{name: np.asarray(v) for name, v in (identity or {}).items()}}


def _rest(model: Any, identity: Mapping[str, Any] | None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(V, 3)` and bone frames `(J, 4, 4)` of the bind pose."""
    rest = _typed(model, _at_rest(model, identity))
    person = {n: rest[n] for n, spec in model.parameter_spec.items() if spec.role == "identity"}
    prepared = model.prepare_identity(**person)
    taken = inspect.signature(model.prepare_pose).parameters
    pose = model.prepare_pose(**{n: v for n, v in rest.items() if n in taken}, identity=prepared)
    frames = {
        n: v for n, v in rest.items() if n in inspect.signature(model.forward_skeleton).parameters
    }
    carried = np.asarray(pose["skinning_transforms"], np.float64)
    bind = np.linalg.inv(carried) @ np.asarray(model.forward_skeleton(**frames), np.float64)
    return np.asarray(prepared["rest_vertices"], np.float64), bind


def _typed(model: Any, values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Convert arrays to the type of the model's runtime."""
    convert, like = model.runtime.asarray, model.rest_vertices
    return {name: convert(np.array(value), like=like) for name, value in values.items()}


def _only_known(what: str, given: Mapping[str, Any], known: set[str]) -> None:
    unknown = sorted(set(given) - known)
    if unknown:
        raise ValueError(
            f"{what} has {', '.join(unknown)}; the model takes {', '.join(sorted(known))}"
        )


def _parents_first(parents: Any) -> tuple[int, ...]:
    """Joints in the model's order, except that parents come before their children."""
    parents = [int(p) for p in parents]
    roots = sum(parent < 0 for parent in parents)
    if roots != 1:
        raise ValueError(f"the model has {roots} root joints, expected one")
    order: list[int] = []
    left = list(range(len(parents)))
    while left:
        joint = next(j for j in left if parents[j] < 0 or parents[j] in order)
        left.remove(joint)
        order.append(joint)
    return tuple(order)


def _known_names(model: Any, more: Mapping[str, str]) -> dict[str, str]:
    """SMPL-X's names of the model's joints, where they are known."""
    found = {native: name for native, name in _MORE_NAMES.items() if native in model.joint_names}
    for joint, native in model.common_joints.items():
        found[native] = _smplx_name(str(joint.value))
    unknown = sorted(set(more) - set(model.joint_names))
    if unknown:
        raise ValueError(f"names has {', '.join(unknown)}, which are not joints of the model")
    return {**found, **more}


def _smplx_name(common: str) -> str:
    """Map `left_index_mcp` to `left_index1`, `left_thumb_cmc` to `left_thumb1`, and so on."""
    side, _, rest = common.partition("_")
    finger, _, joint = rest.partition("_")
    number = (_THUMB if finger == "thumb" else _PHALANGES).get(joint)
    return common if number is None else f"{side}_{finger}{number}"


def _regressor(
    joints: Float[np.ndarray, "J 3"], vertices: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "J V"]:
    """Least-norm affine combinations of near vertices that give the joints."""
    from scipy.spatial import cKDTree

    count = min(_REGRESSED_FROM, len(vertices))
    _, near = cKDTree(vertices).query(joints, k=count)
    regressor = np.zeros((len(joints), len(vertices)))
    for row, (joint, rows) in enumerate(zip(joints, near.reshape(len(joints), -1), strict=True)):
        conditions = np.concatenate([(vertices[rows] - joint).T, np.ones((1, count))])
        regressor[row, rows] = np.linalg.lstsq(conditions, np.array([0.0, 0, 0, 1]), rcond=None)[0]
    return regressor


def _check_rigid(
    body: BodyModel, turned: np.ndarray, joints: np.ndarray, reached: np.ndarray
) -> None:
    """Check that rotations about the parents give the joint positions."""
    parents = np.asarray(body.tree.parents)[1:]
    bone = (turned[..., parents, :, :] @ (joints[1:] - joints[parents])[..., None])[..., 0]
    gap = np.linalg.norm(reached[..., 1:, :] - reached[..., parents, :] - bone, axis=-1)
    worst = gap.reshape(-1, len(parents)).max(0)
    if worst.max() > _RIGID_M:
        joint = body.tree.names[1 + int(worst.argmax())]
        raise ValueError(
            f"the pose moves {joint} by {1e3 * worst.max():.1f} mm along its bone; avatars "
            "are driven by rotations only: leave out parameters that stretch bones"
        )
