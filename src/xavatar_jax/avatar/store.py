"""Avatars in one file: config, learned arrays, and which body they belong to. No pickle."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx

from .._version import __version__
from ..body import BodyModel, load_body, synthetic_body
from ..fields import HashGeometry
from ..files import (
    flatten_named,
    load_arrays,
    load_header,
    refuse_newer,
    save_arrays,
    unflatten_named,
)
from ..training import (
    AvatarFields,
    FitConfig,
    config_from_dict,
    config_to_dict,
    fresh_fields,
    trainable_geometry,
    trainable_skinning,
)
from .avatar import Avatar

_FORMAT = 1


def save_avatar(avatar: Avatar, path: str | os.PathLike[str]) -> None:
    """Write an avatar: learned arrays, shape, config and the body's path, kind, gender, checksum.

    The body's own arrays, which are licensed, and what is derived from them are left out.
    """
    arrays = flatten_named(_kept(avatar.fields))
    source = avatar.body.source
    header = {
        "format": _FORMAT,
        "kind": "avatar",
        "version": __version__,
        "steps": avatar.steps,
        "config": config_to_dict(avatar.config),
        "body": {
            "path": source.path,
            "kind": source.kind,
            "gender": source.gender,
            "checksum": source.checksum,
            "num_betas": avatar.body.num_betas,
            "num_expression": avatar.body.num_expression,
        },
    }
    save_arrays(path, {"betas": avatar.betas, **arrays}, header)


def load_avatar(
    path: str | os.PathLike[str],
    *,
    body: BodyModel | None = None,
    fields: AvatarFields | None = None,
) -> Avatar:
    """Read an avatar written by `Avatar.save`.

    Without `body` the model file it was learned on is loaded again; the bundled body is made anew
    if need be. `fields`, for an avatar with fields of one's own class: any of their structure,
    whose learned arrays are replaced.

    **Raises:** `FileNotFoundError` if the body's file is gone, `ValueError` if the body given, or
    the file found, is another one, or if the avatar file is damaged or from a newer version.
    """
    arrays, header = load_arrays(path)
    check_header(path, header)
    known = header["body"]
    body = _find_body(path, known, None) if body is None else body
    if body.source.checksum != known["checksum"]:
        raise ValueError(
            f"{os.fspath(path)}: learned on another body. It needs {known['kind']} "
            f"({known['gender']}), checksum {known['checksum'][:12]}..., once at {known['path']}; "
            f"given was {body.source.describe()}, checksum {body.source.checksum[:12]}..."
        )
    config = config_from_dict(header["config"])
    betas = arrays.pop("betas")
    if fields is None:
        fields = fresh_fields(body, config, betas)
    kept = unflatten_named(_kept(fields), arrays, source=os.fspath(path))
    return Avatar(body, betas, eqx.combine(kept, fields), config, header["steps"])


def _kept(fields: AvatarFields) -> AvatarFields:
    """Leaves that the file holds: all that can be learned, whether or not this run did."""
    geometry = trainable_geometry(fields.geometry)
    if isinstance(fields.geometry, HashGeometry):
        geometry = eqx.tree_at(lambda g: g.fixed_leaves, geometry, replace_fn=lambda _: True)
    return eqx.filter(fields, AvatarFields(trainable_skinning(fields.skinning), geometry))


def load_avatar_body(
    path: str | os.PathLike[str], file: str | os.PathLike[str] | None = None
) -> BodyModel:
    """The body model that an avatar file names, or the one in `file`, with as many coefficients.

    It is not compared with the avatar's: `load_avatar(path, body=...)` does that.

    **Raises:** as `load_avatar` and `load_body`.
    """
    header = load_header(path)
    check_header(path, header)
    return _find_body(path, header["body"], file)


def load_avatar_config(path: str | os.PathLike[str]) -> FitConfig:
    """The config of the run that an avatar file comes from.

    **Raises:** `ValueError` for a file that is none of an avatar.
    """
    header = load_header(path)
    check_header(path, header)
    return config_from_dict(header["config"])


def check_header(path: str | os.PathLike[str], header: Mapping[str, Any]) -> None:
    """**Raises:** `ValueError` unless it is the header of an avatar file that we can read."""
    if header.get("kind") != "avatar":
        raise ValueError(f"{os.fspath(path)}: not an avatar file")
    refuse_newer(path, header, _FORMAT, written_by=header["version"])


def _find_body(
    path: str | os.PathLike[str], known: dict[str, Any], file: str | os.PathLike[str] | None
) -> BodyModel:
    place = Path(known["path"]) if file is None else Path(file)
    if file is not None or place.exists():
        return load_body(
            place,
            kind=known["kind"] if known["kind"] != "other" else "smplx",
            gender=known["gender"],
            num_betas=known["num_betas"],
            num_expression=known["num_expression"],
        )
    if place.name.startswith("synthetic_body"):
        return synthetic_body()
    raise FileNotFoundError(
        f"{os.fspath(path)}: its body model is not at {place} any more. Pass the {known['kind']} "
        f"({known['gender']}) model it was learned on: load_avatar(path, body=load_body(...))"
    )
