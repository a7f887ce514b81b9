"""Bodies of the package `body-models` (ANNY, MHR, the SMPL family) as bodies of this library."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..kinematics import KinematicTree, matrix_to_axis_angle
from .identity import body_checksum
from .model import BodyModel, BodySource
from .params import BodyParams
from .parts import derive_part_labels

_PHALANGES = {"mcp": 1, "pip": 2, "dip": 3}
_THUMB = {"cmc": 1, "mcp": 2, "ip": 3}
# Joints that the package's common vocabulary leaves out, by the names its models give them.
_MORE_NAMES = {"jaw": "jaw", "eye.L": "left_eye", "eye.R": "right_eye"}
# A joint that ends up further from where the model puts it has moved along its bone.
_RIGID_M = 1e-3
_REGRESSED_FROM = 64  # vertices nearest to a joint


def body_from_model(
    model: Any,
    *,
    identity: Mapping[str, Any] | None = None,
    names: Mapping[str, str] | None = None,
) -> BodyModel:
    """A body with the mesh, tree and skinning weights of a model of the package `body-models`.

    `model` is a `body_models.SkinnedModel`, or a name that `body_models.create_model` knows
    ("anny"). The person's shape is part of the result, which has no shape or expression
    coefficients: `identity` gives the model's own parameters of that role (default: its rest
    values). Pose correctives are not taken over; an avatar learns its own. Joints take SMPL-X's
    names where the package knows what they are, by which parts and starts are found; `names`
    adds to that, from the model's name to SMPL-X's.

    **Raises:** `FileNotFoundError` with the command that fetches a model's files; `ValueError`
    for unknown identity parameters, or joint names that repeat.
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
    regressor = _regressor(joints, vertices)
    dtype = jnp.asarray(0.0).dtype

    def cast(value: np.ndarray) -> Any:
        return jnp.asarray(value, dtype)

    count, bones = len(vertices), len(joints)
    return BodyModel(
        template=cast(vertices),
        faces=faces,
        shape_dirs=cast(np.zeros((count, 3, 0))),
        expression_dirs=cast(np.zeros((count, 3, 0))),
        pose_dirs=cast(np.zeros((count, 3, 9 * (bones - 1)))),
        joint_regressor=cast(regressor),
        joint_template=cast(joints),
        joint_shape_dirs=cast(np.zeros((bones, 3, 0))),
        joint_expression_dirs=cast(np.zeros((bones, 3, 0))),
        weights=cast(weights / weights.sum(1, keepdims=True)),
        part_labels=derive_part_labels(tree, weights),
        colors=None,
        hand_mean=cast(np.zeros((bones, 3))),
        hand_components={},
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
    """Parameters of `body_from_model(model, identity=identity)` for a pose of the model's own.

    `parameters` are arguments of the model's `forward_vertices` but for its identity, one frame or
    a batch of them; what is left out is at rest.

    **Raises:** `ValueError` for unknown parameters, for a body that is not the model's, or naming
    the joint where a pose stretches a bone, which rotations cannot say.
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
    # What is left out takes the batch of what is given.
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
    except Exception as error:  # it fetches what is missing, and fails in as many ways as a network
        raise FileNotFoundError(
            f"the files of {name} are not at hand ({error}); `body-models download {name}` "
            "fetches them where there is a network"
        ) from error


def _at_rest(model: Any, identity: Mapping[str, Any] | None) -> dict[str, np.ndarray]:
    """Every parameter of one frame: rest values, and the identity asked for."""
    specs = model.parameter_spec
    of_person = {name for name, spec in specs.items() if spec.role == "identity"}
    _only_known("identity", identity or {}, of_person)
    rest = {name: np.asarray(value) for name, value in model.get_rest_pose().items()}
    return {**rest, **{name: np.asarray(v) for name, v in (identity or {}).items()}}


def _rest(model: Any, identity: Mapping[str, Any] | None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(V, 3)` and bone frames `(J, 4, 4)` that the skinning weights were bound at."""
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
    """Arrays as the model's runtime wants them."""
    like = model.rest_vertices
    return {
        name: model.runtime.asarray(np.array(value), like=like) for name, value in values.items()
    }


def _only_known(what: str, given: Mapping[str, Any], known: set[str]) -> None:
    unknown = sorted(set(given) - known)
    if unknown:
        raise ValueError(
            f"{what} has {', '.join(unknown)}; the model takes {', '.join(sorted(known))}"
        )


def _parents_first(parents: Any) -> tuple[int, ...]:
    """Joints in the model's order, but for those that it lists before their parents; one root."""
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
    """SMPL-X's names of the model's joints, where it is known what they are."""
    found = {native: name for native, name in _MORE_NAMES.items() if native in model.joint_names}
    for joint, native in model.common_joints.items():
        found[native] = _smplx_name(str(joint.value))
    unknown = sorted(set(more) - set(model.joint_names))
    if unknown:
        raise ValueError(f"names has {', '.join(unknown)}, which are no joints of the model")
    return {**found, **more}


def _smplx_name(common: str) -> str:
    """`left_index_mcp` is `left_index1`, `left_thumb_cmc` is `left_thumb1`; others stay."""
    side, _, rest = common.partition("_")
    finger, _, joint = rest.partition("_")
    number = (_THUMB if finger == "thumb" else _PHALANGES).get(joint)
    return common if number is None else f"{side}_{finger}{number}"


def _regressor(
    joints: Float[np.ndarray, "J 3"], vertices: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "J V"]:
    """Affine combinations of near vertices that give the joints: of all, those of least norm."""
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
    """Joints are where rotations about their parents put them."""
    parents = np.asarray(body.tree.parents)[1:]
    bone = (turned[..., parents, :, :] @ (joints[1:] - joints[parents])[..., None])[..., 0]
    gap = np.linalg.norm(reached[..., 1:, :] - reached[..., parents, :] - bone, axis=-1)
    worst = gap.reshape(-1, len(parents)).max(0)
    if worst.max() > _RIGID_M:
        joint = body.tree.names[1 + int(worst.argmax())]
        raise ValueError(
            f"the pose moves {joint} by {1e3 * worst.max():.1f} mm along its bone; an avatar is "
            "driven by rotations alone: leave out parameters that stretch bones"
        )
