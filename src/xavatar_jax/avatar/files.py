"""The format of avatar files: what describes the model, its arrays, and the body it is on.

Format 2 has a header with `method`, `skeleton` ("whole" or "body_only"), `steps`, `model` (the
`ModelSpec`), `search` (the `SearchSpec`), `options` (a record of training options, which is never
interpreted) and `body`. Arrays are named after the model's stored leaves; `betas` comes with them.
Format 1, of version 0.1.0, had the training config in place of `model`, `search` and `options`.
Nothing is pickled.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._version import __version__
from ..body import BodyModel, canonical_params, load_body
from ..fields import (
    AvatarModel,
    ModelSpec,
    build_model,
    check_model,
    dataclass_from_dict,
    stored_leaves,
)
from ..files import cache_path, flatten_named, load_arrays, load_header, refuse_newer, save_arrays
from .queries import SearchSpec

_FORMAT = 2
# Name of the bundled body's file; 0.1.0 did not record it in another way.
_BUNDLED = "synthetic_body"
Skeleton = Literal["whole", "body_only"]
_HEADER = {
    "version": str, "method": str, "skeleton": str, "steps": int, "model": dict, "search": dict,
    "options": dict, "body": dict,
}  # fmt: skip
_BODY = {
    "path": str, "kind": str, "gender": str, "checksum": str, "num_betas": int,
    "num_expression": int,
}  # fmt: skip


class Storable(Protocol):
    """The parts of an avatar that a file keeps. See `Avatar`."""

    @property
    def betas(self) -> Float[np.ndarray, " S"]: ...
    @property
    def model(self) -> AvatarModel: ...
    @property
    def spec(self) -> ModelSpec: ...
    @property
    def search(self) -> SearchSpec: ...
    @property
    def steps(self) -> int: ...
    @property
    def method(self) -> str: ...
    @property
    def options(self) -> Mapping[str, Any]: ...


@dataclass(frozen=True, eq=False)
class AvatarHeader:
    """The description in an avatar file, whatever its format.

    - `body`: path, kind, gender, checksum, num_betas and num_expression of the body model.
    - `options`: training options as plain values.
    """

    version: str
    method: str
    skeleton: Skeleton
    steps: int
    spec: ModelSpec
    search: SearchSpec
    options: Mapping[str, Any]
    body: Mapping[str, Any]


def save_avatar(
    avatar: Storable,
    path: str | os.PathLike[str],
    body: BodyModel,
    skeleton: Skeleton = "whole",
) -> None:
    """Write an avatar: the stored arrays of its model, shape, specs, and a reference to `body`.

    The body's own arrays, which are licensed, and what is derived from them are left out.
    """
    source = body.source
    facts = {name: getattr(source, name) for name in ("path", "kind", "gender", "checksum")}
    header = {
        "format": _FORMAT,
        "kind": "avatar",
        "version": __version__,
        "method": avatar.method,
        "skeleton": skeleton,
        "steps": avatar.steps,
        "model": avatar.spec.to_dict(),
        "search": asdict(avatar.search),
        "options": dict(avatar.options),
        "body": {**facts, "num_betas": body.num_betas, "num_expression": body.num_expression},
    }
    arrays = flatten_named(eqx.filter(avatar.model, stored_leaves(avatar.model)))
    save_arrays(path, {"betas": avatar.betas, **arrays}, header)


def load_avatar_header(path: str | os.PathLike[str]) -> AvatarHeader:
    """The description in an avatar file, without its arrays.

    **Raises:** `ValueError` naming file and entry for a file that is no avatar, from a newer
    version, or damaged.
    """
    return _checked(path, load_header(path))


def load_avatar_body(
    path: str | os.PathLike[str], file: str | os.PathLike[str] | None = None
) -> BodyModel:
    """The body model that an avatar file names, or the one in `file`, with as many coefficients.

    It is not compared with the avatar's: `load_avatar(path, body=...)` does that.

    **Raises:** as `load_avatar` and `load_body`.
    """
    return find_body(path, load_avatar_header(path).body, file)


def needs_bundled_body(path: str | os.PathLike[str]) -> bool:
    """Whether an avatar was fitted on the bundled body, as `xa.synthetic_body` builds it.

    **Raises:** as `load_avatar`.
    """
    return Path(load_avatar_header(path).body["path"]).name.startswith(_BUNDLED)


def read_avatar(
    path: str | os.PathLike[str],
) -> tuple[AvatarHeader, Float[np.ndarray, " S"], dict[str, np.ndarray]]:
    """Header, betas and the arrays of the model.

    **Raises:** as `load_avatar_header`.
    """
    arrays, header = load_arrays(path)
    known = _checked(path, header)
    betas = arrays.pop("betas", None)
    if betas is None or betas.ndim != 1 or betas.dtype.kind != "f" or not np.isfinite(betas).all():
        raise ValueError(f"{os.fspath(path)}: betas must be a vector of finite numbers")
    return known, betas, arrays


def restore_model(
    path: str | os.PathLike[str],
    spec: ModelSpec,
    body: BodyModel,
    betas: Float[np.ndarray, " S"],
    arrays: Mapping[str, np.ndarray],
    like: AvatarModel | None = None,
) -> AvatarModel:
    """The model of a file: built from its spec on the body, with the file's arrays.

    Layouts of grids come from the file, so arrays may have other sizes than in the built model.
    `like` replaces the built model, for models that no spec describes.

    **Raises:** `ValueError` naming file and array for one that is missing, unknown, not finite or
    does not fit.
    """
    model = like
    if model is None:
        model = build_model(spec, body, key=jax.random.key(0), betas=betas)
    leaves, structure = jax.tree_util.tree_flatten_with_path(
        eqx.filter(model, stored_leaves(model))
    )
    names = [jax.tree_util.keystr(where).lstrip(".") for where, _ in leaves]
    unknown = sorted(set(arrays) - set(names))
    if unknown:
        raise ValueError(f"{os.fspath(path)}: array {unknown[0]!r} belongs to no leaf of the model")
    new = []
    for name, (_, leaf) in zip(names, leaves, strict=True):
        if name in arrays:
            new.append(_checked_array(f"{os.fspath(path)}: {name}", arrays[name], leaf))
        elif _LAYOUT.intersection(name.replace("[", ".").split(".")):
            new.append(leaf)  # 0.1.0 kept no layouts: its were those of today
        else:
            raise ValueError(f"{os.fspath(path)}: no array {name!r}")
    restored = eqx.combine(jax.tree_util.tree_unflatten(structure, new), model)
    try:
        check_model(restored)
        eqx.filter_eval_shape(_evaluate, restored, canonical_params(body, jnp.asarray(betas)))
    except Exception as error:  # whatever a model raises for arrays that do not fit each other
        raise ValueError(f"{os.fspath(path)}: its arrays do not fit: {error}") from error
    return restored


# Leaves that lay a model out in space. Files of format 1 lack them.
_LAYOUT = {
    *("origin", "shapes", "offsets", "low", "shape", "reach", "detail_low", "detail_high"),
    "correction_grids",
}


def _evaluate(model: AvatarModel, params: Any) -> Any:
    x = jnp.zeros(3)
    value = model.geometry(x, model.geometry.condition(params))
    assert value.level.shape == (), f"levels of shape {value.level.shape}"
    weights = model.skinning(x)
    assert weights.shape == (params.pose.shape[0],), f"weights of shape {weights.shape}"
    color = None if model.color is None else model.color(x, value.feature, x)
    return value, weights, color


def _checked_array(what: str, value: np.ndarray, leaf: Any) -> Any:
    leaf = np.asarray(leaf)
    kinds = "f" if leaf.dtype.kind == "f" else "iu" if leaf.dtype.kind in "iu" else leaf.dtype.kind
    if value.dtype.kind not in kinds:
        raise ValueError(f"{what} has type {value.dtype}, expected {leaf.dtype}")
    if value.ndim != leaf.ndim or (0 in value.shape and 0 not in leaf.shape):
        raise ValueError(f"{what} has shape {value.shape}, expected as in {leaf.shape}")
    # Ranges that were never narrowed are infinite.
    unbounded = leaf.dtype.kind == "f" and np.isinf(leaf).any()
    if value.dtype.kind == "f" and (
        np.isnan(value).any() if unbounded else not np.isfinite(value).all()
    ):
        raise ValueError(f"{what} is not finite")
    return jnp.asarray(value, leaf.dtype)


def find_body(
    path: str | os.PathLike[str],
    known: Mapping[str, Any],
    file: str | os.PathLike[str] | None = None,
) -> BodyModel:
    """The body model of an avatar file at its recorded path, in the cache if bundled, or `file`.

    **Raises:** `FileNotFoundError` if it is gone.
    """
    place = Path(known["path"]) if file is None else Path(file)
    bundled = place.name.startswith(_BUNDLED)
    if file is None and bundled and not place.exists():
        place = cache_path() / place.name
    if file is not None or place.exists():
        return load_body(
            place,
            kind=known["kind"] if known["kind"] != "other" else "smplx",
            gender=known["gender"],
            num_betas=known["num_betas"],
            num_expression=known["num_expression"],
        )
    if bundled:
        raise FileNotFoundError(
            f"{os.fspath(path)}: fitted on the bundled body, which is not in the cache folder: "
            "pass body=xa.synthetic_body(), which builds it again"
        )
    raise FileNotFoundError(
        f"{os.fspath(path)}: its body model is no longer at {place}. Pass the {known['kind']} "
        f"({known['gender']}) model it was fitted on: load_avatar(path, body=load_body(...))"
    )


def _checked(path: str | os.PathLike[str], header: Any) -> AvatarHeader:
    """The header as a record. **Raises:** `ValueError` naming a wrong entry."""
    name = os.fspath(path)
    if not isinstance(header, dict) or header.get("kind") != "avatar":
        raise ValueError(f"{name}: not an avatar file")
    _check_types(name, header, {"format": int, "version": str})
    refuse_newer(path, header, _FORMAT, written_by=header["version"])
    try:
        if header["format"] == 1:
            header = _from_format_1(name, header)
        _check_types(name, header, _HEADER)
        _check_types(f"{name}: body", header["body"], _BODY)
        if header["skeleton"] not in ("whole", "body_only"):
            raise ValueError(f"skeleton must be whole or body_only, found {header['skeleton']!r}")
        spec = _typed(ModelSpec, header["model"], "model")
        search = _typed(SearchSpec, header["search"], "search")
    except (ValueError, TypeError, KeyError) as error:
        text = str(error)
        raise ValueError(text if text.startswith(name) else f"{name}: {text}") from error
    return AvatarHeader(
        header["version"], header["method"], header["skeleton"], header["steps"], spec, search,
        header["options"], header["body"],
    )  # fmt: skip


def _check_types(name: str, values: Mapping[str, Any], types: Mapping[str, type]) -> None:
    for entry, kind in types.items():
        if entry not in values:
            raise ValueError(f"{name}: no entry {entry!r}")
        value = values[entry]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ValueError(f"{name}: {entry} must be {kind.__name__}, found {value!r:.60}")


def _typed(kind: Any, values: Mapping[str, Any], name: str) -> Any:
    """A spec from plain values. **Raises:** `ValueError` for a value of another type."""
    built = dataclass_from_dict(kind, values, name)
    default, given = _plain(asdict(kind())), _plain(asdict(built))
    _compare_types(default, given, name)
    return built


def _plain(values: Any) -> Any:
    return json.loads(json.dumps(values))


def _compare_types(default: Any, given: Any, name: str) -> None:
    """Every value has the type of the default: numbers may be integers where floats are due."""
    if isinstance(default, dict) and isinstance(given, dict):
        for entry in default:
            _compare_types(default[entry], given[entry], f"{name}.{entry}")
        return
    kinds: Any = (int, float) if isinstance(default, float) else type(default)
    wrong = not isinstance(given, kinds) or isinstance(given, bool) != isinstance(default, bool)
    if isinstance(given, list) and not wrong:
        wrong = not all(isinstance(v, int | float) and not isinstance(v, bool) for v in given)
    if wrong:
        raise ValueError(f"{name} must be like {default!r}, found {given!r:.60}")


def _from_format_1(name: str, header: Mapping[str, Any]) -> dict[str, Any]:
    """A header of version 0.1.0, whose model was described by its training config."""
    _check_types(name, header, {"version": str, "steps": int, "config": dict, "body": dict})
    config = header["config"]
    _check_types(
        f"{name}: config", config, dict.fromkeys(("skinning", "geometry", "search", "losses"), dict)
    )
    skinning, search, losses = dict(config["skinning"]), config["search"], config["losses"]
    skinning.pop("learned", None)
    moves = losses["surface"] > 0 or skinning["start"] == "random"
    skinning["around"] = "person" if moves else "mean"
    kept = ("starts", "grid", "keep", "atol", "max_steps")
    return {
        **header,
        "method": "xavatar",
        "skeleton": "whole",
        "model": {
            "skinning": skinning,
            "geometry": config["geometry"],
            "link": {"kind": "occupancy", "softness": losses["softness"]},
        },
        "search": {entry: search[entry] for entry in kept if entry in search},
        "options": config,
    }
