"""Read body models of the SMPL family, and any other tree in the same layout."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..files import cache_dir, load_npz, load_pickle
from ..kinematics import KinematicTree
from .identity import body_checksum
from .joints import SMPL_TREE, SMPLH_TREE, SMPLX_TREE, mano_tree, pose_groups
from .model import BodyModel, BodySource
from .parts import PARTS, derive_part_labels

_DOWNLOADS = {
    "smplx": "https://smpl-x.is.tue.mpg.de",
    "smplh": "https://mano.is.tue.mpg.de",
    "mano": "https://mano.is.tue.mpg.de",
    "smpl": "https://smpl.is.tue.mpg.de",
}
_SHAPE_SPACE = 300  # SMPL-X: shape in columns 0 to 299, expression from 300
_OLD_SHAPE_SPACE = 10  # first SMPL-X release: ten of each
_ROUNDED = 1e-3  # of a row of weights: what float16 leaves


def load_body(
    path: str | os.PathLike[str] | None = None,
    *,
    kind: str = "smplx",
    gender: str = "neutral",
    num_betas: int | None = None,
    num_expression: int | None = None,
) -> BodyModel:
    """Load a SMPL, SMPL-H, SMPL-X or MANO model, or another tree in the same layout.

    `path` is an `.npz` or `.pkl` file, or a folder in the layout of `smplx.create`
    (`DIR/smplx/SMPLX_NEUTRAL.npz`), where `kind` and `gender` choose the file. Without a path the
    environment variable `SMPLX_MODEL_DIR` is used. Pickles and object arrays are read under
    restriction; chumpy is not needed. `num_betas` and `num_expression` keep fewer columns than the
    file has. Arrays are float32, or float64 when `jax_enable_x64` is on.

    **Raises:** `FileNotFoundError` with the paths tried and where to get the model; `ValueError`
    naming the file, the entry, the shape found and the shape expected.
    """
    file = _find(path, kind, gender)
    suffix = file.suffix.lower()
    if suffix == ".npz":
        data = load_npz(file)
    elif suffix == ".pkl":
        data = load_pickle(file)
    else:
        raise ValueError(f"{file}: a body model is an .npz or .pkl file, not {suffix or 'this'}")
    if not isinstance(data, dict):
        raise ValueError(f"{file}: expected a dictionary of arrays, found {type(data).__name__}")
    return _build(file, data, gender, num_betas, num_expression)


def synthetic_body(cache: str | os.PathLike[str] | None = None) -> BodyModel:
    """The bundled human, made by code on first use (under a minute) and kept in the cache folder.

    An SMPL-X tree, ten shape and ten expression directions, free of any licence but this project's.
    `cache` overrides the user's cache folder.
    """
    from .synthetic import SYNTHETIC_BODY_VERSION, write_synthetic_body

    path = cache_dir(cache) / f"synthetic_body-{SYNTHETIC_BODY_VERSION}.npz"
    if not path.exists():
        write_synthetic_body(path)
    return load_body(path, num_betas=10, num_expression=10)


def _find(path: str | os.PathLike[str] | None, kind: str, gender: str) -> Path:
    if path is None:
        path = os.environ.get("SMPLX_MODEL_DIR")
        if not path:
            raise FileNotFoundError(
                "no body model given: pass a path, or set SMPLX_MODEL_DIR to a folder in the "
                "layout of smplx.create; xavatar_jax.synthetic_body() needs no file"
            )
    root = Path(path).expanduser()
    if root.is_file():
        return root
    name = f"{kind.upper()}_{gender.upper()}"
    tried = [root] if not root.is_dir() else []
    if root.is_dir():
        tried = [
            folder / f"{name}{suffix}"
            for folder in (root / kind.lower(), root)
            for suffix in (".npz", ".pkl")
        ]
        for candidate in tried:
            if candidate.is_file():
                return candidate
    listing = "\n  ".join(str(candidate) for candidate in tried)
    raise FileNotFoundError(
        f"no body model found. Tried:\n  {listing}\n"
        f"Download {kind.upper()} from {_DOWNLOADS.get(kind.lower(), 'its own site')} (its licence "
        "forbids shipping it here), or use xavatar_jax.synthetic_body()."
    )


def _build(
    file: Path,
    data: dict[str, Any],
    gender: str,
    num_betas: int | None,
    num_expression: int | None,
) -> BodyModel:
    template = _array(file, data, "v_template", (None, 3))
    vertices = len(template)
    parents = _array(file, data, "kintree_table", (2, None))[0].astype(np.int64)
    joints = len(parents)
    tree, kind = _tree(file, data, parents)
    faces = _array(file, data, "f", (None, 3)).astype(np.int32)
    if len(faces) and (faces.min() < 0 or faces.max() >= vertices):
        raise ValueError(f"{file}: f refers to vertex {faces.max()}, but there are {vertices}")
    weights = _weights(file, data, (vertices, joints))
    regressor = _dense(data.get("J_regressor"))
    regressor = _array(file, {"J_regressor": regressor}, "J_regressor", (joints, vertices))
    posedirs = _array(file, data, "posedirs", (vertices, 3, 9 * (joints - 1)))
    shapedirs = _array(file, data, "shapedirs", (vertices, 3, None))
    shape, expression = _split_shape(shapedirs, kind, num_betas, num_expression, file)
    mean, components = _hands(file, data, tree)
    labels = data.get("part_labels")
    if labels is None:
        labels = derive_part_labels(tree, weights)
    else:
        labels = _array(file, data, "part_labels", (vertices,)).astype(np.int8)
        if labels.min() < 0 or labels.max() >= len(PARTS):
            raise ValueError(f"{file}: part_labels must be 0 to {len(PARTS) - 1}")
    colors = data.get("vertex_colors")
    if colors is not None:
        colors = _array(file, data, "vertex_colors", (vertices, 3)).astype(np.uint8)

    dtype = jnp.asarray(0.0).dtype  # float64 when x64 is on

    def regress(directions: np.ndarray) -> np.ndarray:
        # In float64: a row sums over thousands of vertices.
        return np.tensordot(regressor.astype(np.float64), directions.astype(np.float64), axes=1)

    def cast(value: np.ndarray) -> Any:
        return jnp.asarray(value, dtype)

    return BodyModel(
        template=cast(template),
        faces=faces,
        shape_dirs=cast(shape),
        expression_dirs=cast(expression),
        pose_dirs=cast(posedirs),
        joint_regressor=cast(regressor),
        joint_template=cast(regress(template)),
        joint_shape_dirs=cast(regress(shape)),
        joint_expression_dirs=cast(regress(expression)),
        weights=cast(weights),
        part_labels=labels,
        colors=colors,
        hand_mean=cast(mean),
        hand_components=components,
        tree=tree,
        source=BodySource(
            path=str(file.resolve()),
            kind=kind,
            gender=_gender(file, gender),
            checksum=body_checksum(
                tree, faces, template, shapedirs, posedirs, regressor, weights, mean, labels
            ),
        ),
    )


def _array(file: Path, data: dict[str, Any], key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    if data.get(key) is None:
        present = ", ".join(sorted(map(str, data)))
        raise ValueError(f"{file}: no entry {key!r}; the file has {present}")
    array = np.asarray(_dense(data[key]))
    expected = tuple("n" if size is None else size for size in shape)
    if array.ndim != len(shape) or any(
        size is not None and size != found for size, found in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(
            f"{file}: {key} has shape {array.shape}, expected {expected}. Is it the model you "
            "meant, and whole?"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{file}: {key} has entries that are not finite")
    return array


def _weights(file: Path, data: dict[str, Any], shape: tuple[int, int]) -> np.ndarray:
    """Skinning weights; rows that do not sum to one, as rounded ones may not, are made to."""
    weights = _array(file, data, "weights", shape)
    total = weights.sum(1, dtype=np.float64)
    bad = (total <= 0) | (weights.min(1, initial=0) < -_ROUNDED)
    if bad.any():
        raise ValueError(
            f"{file}: weights of {bad.sum()} vertices are negative or all zero, the first those of "
            f"vertex {int(np.argmax(bad))}; each row is shares of one"
        )
    off = np.abs(total - 1) > _ROUNDED
    if not off.any():
        return weights
    warnings.warn(
        f"{file}: weights of {off.sum()} vertices do not sum to one ({total.min():.3f} to "
        f"{total.max():.3f}); they have been divided by their sum",
        stacklevel=2,
    )
    return weights / total[:, None]


def _dense(value: Any) -> Any:
    return value.toarray() if hasattr(value, "toarray") else value


def _tree(file: Path, data: dict[str, Any], parents: np.ndarray) -> tuple[KinematicTree, str]:
    count = len(parents)
    parents = parents.copy()
    parents[0] = -1  # stored as an unsigned -1
    found = tuple(int(p) for p in parents)
    side = "left" if "left" in file.stem.lower() else "right"
    known = {"smpl": SMPL_TREE, "smplh": SMPLH_TREE, "smplx": SMPLX_TREE, "mano": mano_tree(side)}
    for kind, tree in known.items():
        if tree.parents == found:
            return tree, kind
    try:
        return KinematicTree(_names(data.get("joint2num"), count), found), "other"
    except ValueError as error:
        raise ValueError(f"{file}: kintree_table: {error}") from None


def _names(joint2num: Any, count: int) -> tuple[str, ...]:
    if isinstance(joint2num, dict) and sorted(map(int, joint2num.values())) == list(range(count)):
        return tuple(str(n) for n, _ in sorted(joint2num.items(), key=lambda item: int(item[1])))
    return tuple(f"joint{j}" for j in range(count))


def _split_shape(
    directions: np.ndarray,
    kind: str,
    num_betas: int | None,
    num_expression: int | None,
    file: Path,
) -> tuple[np.ndarray, np.ndarray]:
    columns = directions.shape[-1]
    if kind != "smplx":
        split = columns
    else:
        split = _SHAPE_SPACE if columns > _SHAPE_SPACE else _OLD_SHAPE_SPACE
    shape, expression = directions[..., :split], directions[..., split:]
    for name, wanted, have in (
        ("num_betas", num_betas, shape.shape[-1]),
        ("num_expression", num_expression, expression.shape[-1]),
    ):
        if wanted is not None and wanted > have:
            raise ValueError(f"{file}: {name}={wanted}, but the file has {have}")
    return shape[..., :num_betas], expression[..., :num_expression]


def _hands(
    file: Path, data: dict[str, Any], tree: KinematicTree
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Mean hand by joint and PCA components by side, where the file has them."""
    mean = np.zeros((tree.num_joints, 3))
    components: dict[str, np.ndarray] = {}
    groups = pose_groups(tree)
    for side, letter in (("left", "l"), ("right", "r")):
        joints = groups[f"{side}_hand_pose"]
        if not joints:
            continue
        for key in (f"hands_mean{letter}", "hands_mean"):
            if data.get(key) is not None:
                mean[list(joints)] = _array(file, data, key, (3 * len(joints),)).reshape(-1, 3)
                break
        for key in (f"hands_components{letter}", "hands_components"):
            if data.get(key) is not None:
                components[side] = _array(file, data, key, (None, 3 * len(joints)))
                break
    return mean, components


def _gender(file: Path, default: str) -> str:
    words = file.stem.lower().replace("-", "_").split("_")
    for gender in ("neutral", "female", "male"):
        if gender in words:
            return gender
    return default
