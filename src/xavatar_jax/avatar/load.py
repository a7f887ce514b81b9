"""Reading avatars, of any kind of skeleton."""

from __future__ import annotations

import os

from ..body import BodyModel
from ..fields import AvatarModel
from .body_only import BodyOnlyAvatar, body_only
from .files import find_body, read_avatar, restore_model
from .implicit import Avatar


def load_avatar(
    path: str | os.PathLike[str],
    *,
    body: BodyModel | None = None,
    model: AvatarModel | None = None,
) -> Avatar | BodyOnlyAvatar:
    """Read an avatar that `save` wrote, also with version 0.1.0.

    Without `body` the model file that it was fitted on is loaded again. `model`, for an avatar
    with user-defined fields: any model of the same structure, whose arrays are replaced.

    **Raises:** `FileNotFoundError` if the body's file is gone; `ValueError` if the body is another
    one, or if the avatar file is damaged or from a newer version.
    """
    header, betas, arrays = read_avatar(path)
    known = header.body
    whole = find_body(path, known) if body is None else body
    if whole.source.checksum != known["checksum"]:
        raise ValueError(
            f"{os.fspath(path)}: fitted on another body. It needs {known['kind']} "
            f"({known['gender']}), checksum {known['checksum'][:12]}..., once at {known['path']}; "
            f"the given one is {whole.source.describe()}, checksum "
            f"{whole.source.checksum[:12]}..."
        )
    own = body_only(whole) if header.skeleton == "body_only" else whole
    restored = restore_model(path, header.spec, own, betas, arrays, model)
    avatar = Avatar(
        own, betas, restored, header.spec, header.search, header.steps, header.method,
        header.options,
    )  # fmt: skip
    return BodyOnlyAvatar(whole, avatar) if header.skeleton == "body_only" else avatar
