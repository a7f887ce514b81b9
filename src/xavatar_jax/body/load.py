"""Read body models of the SMPL family, and of any other joint tree in the same layout."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..files import load_npz, load_pickle
from ..kinematics import KinematicTree
from .joints import SMPL_TREE, SMPLH_TREE, SMPLX_TREE, mano_tree, pose_groups
from .model import BodyModel, BodySource, body_checksum, make_body
from .parts import STANDARD_PARTS, derive_part_labels, standard_parts

_DOWNLOADS = {
    "smplx": "https://smpl-x.is.tue.mpg.de",
    "smplh": "https://mano.is.tue.mpg.de",
    "mano": "https://mano.is.tue.mpg.de",
    "smpl": "https://smpl.is.tue.mpg.de",
}
_SHAPE_SPACE = 300  # SMPL-X 1.1: shape in columns 0 to 299, expression from 300
_OLD_SHAPE_SPACE = 10  # SMPL-X 1.0: ten of each
_ROUNDED = 1e-3  # rounding error of a row of weights stored as float16
_REGRESSED = 1e-2  # largest difference from one of a row of the joint regressor
_EXTENT_M = (0.02, 10.0)  # smallest and largest size of a template
_LARGEST = 1e10  # largest magnitude of any other number in a model file
_GENDERS = ("neutral", "female", "male")


def load_body(
    path: str | os.PathLike[str] | None = None,
    *,
    kind: str = "smplx",
    gender: str = "neutral",
    num_betas: int | None = None,
    num_expression: int | None = None,
) -> BodyModel:
    """Load a SMPL, SMPL-H, SMPL-X or MANO model, or another joint tree in the same layout.

    `path` is an `.npz` or `.pkl` file, or a folder in the layout of `smplx.create`
    (`DIR/smplx/SMPLX_NEUTRAL.npz`) or of the downloads (`DIR/smplh/male/model.npz`,
    `DIR/smpl/basicmodel_f_lbs_10_207_0_v1.1.0.pkl`), where `kind` and `gender` choose the file.
    The default path is the environment variable `SMPLX_MODEL_DIR`. A gender in the name of the
    file or its folder takes precedence over `gender`.

    Pickles and object arrays are read without executing code; chumpy is not needed. `num_betas`
    and `num_expression` limit the columns that are kept. Arrays are float32, or float64 when
    `jax_enable_x64` is on.

    **Raises:** `FileNotFoundError` with the paths tried and where to get the model; `ValueError`
    naming the file, the entry, the value found and the value expected.
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
    kind, gender = kind.lower(), gender.lower()
    tried = [root] if not root.is_dir() else [
        folder / f"{name}{suffix}"
        for name in (f"{kind}_{gender}".upper(), f"{gender}/model", f"basic[mM]odel_{gender}_*",
                     f"basic[mM]odel_{gender[:1]}_*")
        for folder in (root / kind, root)
        for suffix in (".npz", ".pkl")
    ]  # fmt: skip
    for candidate in tried:
        found = sorted(root.glob(candidate.relative_to(root).as_posix())) if root.is_dir() else []
        if found and found[0].is_file():
            return found[0]
    listing = "\n  ".join(str(candidate) for candidate in tried)
    raise FileNotFoundError(
        f"no body model found. Tried:\n  {listing}\n"
        f"Download {kind.upper()} from {_DOWNLOADS.get(kind.lower(), 'its website')} (its licence "
        "does not allow this library to include it), or use xavatar_jax.synthetic_body()."
    )


def _build(
    file: Path, data: dict[str, Any], gender: str, num_betas: int | None, num_expression: int | None
) -> BodyModel:
    template = _array(file, data, "v_template", (None, 3))
    vertices = len(template)
    parents = _integers(file, data, "kintree_table", (2, None))[0]
    joints = len(parents)
    tree, kind = _tree(file, data, parents)
    faces = _integers(file, data, "f", (None, 3), most=vertices - 1).astype(np.int32)
    weights = _weights(file, data, (vertices, joints))
    _check_size(file, template, faces)
    regressor = _array(file, data, "J_regressor", (joints, vertices))
    _check_regressor(file, regressor, tree)
    posedirs = _array(file, data, "posedirs", (vertices, 3, 9 * (joints - 1)))
    shapedirs = _array(file, data, "shapedirs", (vertices, 3, None))
    shape, expression = _split_shape(shapedirs, kind, num_betas, num_expression, file)
    mean, components = _hands(file, data, tree)
    if data.get("part_labels") is None:
        labels = derive_part_labels(tree, weights)
    else:
        labels = _integers(file, data, "part_labels", (vertices,), most=len(STANDARD_PARTS) - 1)
        labels = labels.astype(np.int8)
    colors = data.get("vertex_colors")
    if colors is not None:
        colors = _integers(file, data, "vertex_colors", (vertices, 3), most=255).astype(np.uint8)

    return make_body(
        template=template,
        faces=faces,
        shape_dirs=shape,
        expression_dirs=expression,
        pose_dirs=posedirs,
        joint_regressor=regressor,
        weights=weights,
        parts=standard_parts(tree, labels),
        colors=colors,
        hand_mean=mean,
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
    """An entry of real, finite numbers with the given shape (None: any size)."""
    if data.get(key) is None:
        present = ", ".join(sorted(map(str, data)))
        raise ValueError(f"{file}: no entry {key!r}; the file has {present}")
    value = data[key]
    try:
        array = np.asarray(value.toarray() if hasattr(value, "toarray") else value)
    except ValueError as error:  # nested lists of different lengths
        raise ValueError(f"{file}: {key} is not an array of numbers: {error}") from None
    expected = tuple("n" if size is None else size for size in shape)
    if array.dtype.kind not in "buif":
        raise ValueError(
            f"{file}: {key} has the type {array.dtype}, expected real numbers of shape {expected}"
        )
    if array.ndim != len(shape) or any(
        size is not None and size != found for size, found in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(
            f"{file}: {key} has shape {array.shape}, expected {expected}. Check that this is the "
            "intended model and that the file is complete"
        )
    if array.dtype.kind != "f":
        return array
    if not np.isfinite(array).all():
        raise ValueError(f"{file}: {key} has entries that are not finite")
    largest = max(array.max(initial=0.0), -array.min(initial=0.0))
    if largest > _LARGEST:
        raise ValueError(
            f"{file}: {key} has entries as large as {largest:.3g}, expected at most {_LARGEST:g}"
        )
    return array


def _integers(
    file: Path,
    data: dict[str, Any],
    key: str,
    shape: tuple[int | None, ...],
    most: int | None = None,
) -> np.ndarray:
    """An entry of integers, stored as any type, in 0 to `most` if that is given."""
    array = _array(file, data, key, shape)
    whole = array.astype(np.int64)
    if array.dtype.kind == "f" and (whole != array).any():
        value = array[whole != array].flat[0]
        raise ValueError(f"{file}: {key} holds {value:g}, expected whole numbers")
    if most is not None and whole.size and (whole.min() < 0 or whole.max() > most):
        value = whole.min() if whole.min() < 0 else whole.max()
        raise ValueError(f"{file}: {key} holds {value}, expected 0 to {most}")
    return whole


def _check_size(file: Path, template: np.ndarray, faces: np.ndarray) -> None:
    """Check that the template is in metres and that its triangles have an area."""
    if not len(template):
        raise ValueError(f"{file}: v_template has no vertices")
    extent = float(np.ptp(template.astype(np.float64), axis=0).max())
    least, most = _EXTENT_M
    if not least <= extent <= most:
        raise ValueError(
            f"{file}: v_template extends over {extent:.4g}, expected {least:g} to {most:g} metres. "
            "Templates in millimetres or centimetres must be scaled, as must shapedirs and posedirs"
        )
    a, b, c = (template[faces[:, k]].astype(np.float64) for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    if area < 1e-6 * extent**2:
        raise ValueError(
            f"{file}: the {len(faces)} triangles in f have an area of {area:.3g} square metres, "
            "expected a surface"
        )


def _check_regressor(file: Path, regressor: np.ndarray, tree: KinematicTree) -> None:
    total = regressor.sum(1, dtype=np.float64)
    joint = int(np.abs(total - 1).argmax())
    if abs(total[joint] - 1) > _REGRESSED:
        raise ValueError(
            f"{file}: row {joint} of J_regressor ({tree.names[joint]}) sums to "
            f"{total[joint]:.4g}, expected 1: a joint is a weighted mean of vertices"
        )


def _weights(file: Path, data: dict[str, Any], shape: tuple[int, int]) -> np.ndarray:
    """Skinning weights. Rows that do not sum to one, as in rounded files, are normalised."""
    weights = _array(file, data, "weights", shape)
    total = weights.sum(1, dtype=np.float64)
    bad = (total <= 0) | (weights.min(1, initial=0) < -_ROUNDED)
    if bad.any():
        raise ValueError(
            f"{file}: weights of {bad.sum()} vertices are negative or all zero, first at "
            f"vertex {int(np.argmax(bad))}; expected rows that sum to one"
        )
    off = np.abs(total - 1) > _ROUNDED
    if not off.any():
        return weights
    warnings.warn(
        f"{file}: weights of {off.sum()} vertices do not sum to one ({total.min():.3f} to "
        f"{total.max():.3f}); they were normalised",
        stacklevel=2,
    )
    return weights / total[:, None]


def _tree(file: Path, data: dict[str, Any], parents: np.ndarray) -> tuple[KinematicTree, str]:
    count = len(parents)
    parents = parents.copy()
    parents[0] = -1  # stored as an unsigned -1
    found = tuple(int(p) for p in parents)
    side = "left" if any("left" in words for words in _words(file)) else "right"
    known = {"smpl": SMPL_TREE, "smplh": SMPLH_TREE, "smplx": SMPLX_TREE, "mano": mano_tree(side)}
    for kind, tree in known.items():
        if tree.parents == found:
            return tree, kind
    try:
        return KinematicTree(_names(data.get("joint2num"), count), found), "other"
    except ValueError as error:
        raise ValueError(f"{file}: kintree_table: {error}") from None


def _names(joint2num: Any, count: int) -> tuple[str, ...]:
    if isinstance(joint2num, dict) and all(np.size(value) == 1 for value in joint2num.values()):
        number = {int(np.asarray(value).item()): str(name) for name, value in joint2num.items()}
        if sorted(number) == list(range(count)):
            return tuple(number[j] for j in range(count))
    return tuple(f"joint{j}" for j in range(count))


def _split_shape(
    directions: np.ndarray, kind: str, num_betas: int | None, num_expression: int | None, file: Path
) -> tuple[np.ndarray, np.ndarray]:
    columns = directions.shape[-1]
    split = columns
    if kind == "smplx" and columns > _SHAPE_SPACE:
        split = _SHAPE_SPACE
    elif kind == "smplx" and columns <= 2 * _OLD_SHAPE_SPACE:
        split = _OLD_SHAPE_SPACE
    elif kind == "smplx" and num_expression != 0:
        warnings.warn(
            f"{file}: shapedirs has {columns} columns, expected 400 or 20 (shape and expression); "
            f"they are read as {columns} shape directions without expression. Pass "
            "num_expression=0 to confirm",
            stacklevel=4,
        )
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
    """Mean hand by joint and PCA components by side, if the file has them."""
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
    """The gender in the name of the file or else of its folder."""
    letters = {gender[0]: gender for gender in _GENDERS}
    for words in _words(file):
        for word in words:
            if word in _GENDERS:
                return word
        if words[0] == "basicmodel" and words[1:2] and words[1] in letters:
            return letters[words[1]]
    return default


def _words(file: Path) -> list[list[str]]:
    """Words of the names of a file and of its folder, in lower case."""
    names = (file.stem, file.absolute().parent.name)
    return [name.lower().replace("-", "_").split("_") for name in names]
