"""What the fields say of posed points."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float, Int

from ..body import BodyModel, BodyParams, bone_transforms
from ..correspondence import StartSet, implicit_root, search_grid, start_table
from ..fields import TabulatedSkinning, pose_grid
from ..training import AvatarFields
from ..training.objective import best_root
from ..training.pool import centred


class Query(NamedTuple):
    """Answers for N posed points.

    - `logit`: `(N,)` occupancy logit at the best root; meaningless where not `found`.
    - `x_c`: `(N, 3)` that root, metres; `found`: `(N,)`.
    """

    logit: Float[Array, " N"]
    x_c: Float[Array, "N 3"]
    found: Bool[Array, " N"]


@eqx.filter_jit
def query_posed(
    fields: AvatarFields,
    table: TabulatedSkinning,
    body: BodyModel,
    points: Float[Array, "N 3"],
    rows: Int[Array, " N"],
    params: BodyParams,
    starts: StartSet = "part_aware",
) -> Query:
    """Search on the tabulated field, keep the root with the largest logit, polish it.

    `rows` are those of a start table with pairs: see `RowFinder`.

    Derivatives, with respect to points, pose and fields, pass the chosen root by the implicit
    function theorem.
    """
    # Near the origin: float32 has a micrometre there, but not in a room or a camera's space.
    points, params = points - params.transl, centred(params)
    transforms = bone_transforms(body, params)
    condition = fields.geometry.condition(params)
    fixed_points, fixed_transforms, fixed_table = jax.lax.stop_gradient((points, transforms, table))
    roots = search_grid(
        pose_grid(fixed_table, fixed_transforms),
        fixed_points,
        rows,
        fixed_transforms,
        start_table(body.tree, starts, pairs=True),
    )
    chosen, found = best_root(fields, jax.lax.stop_gradient(roots.x_c), roots.valid, condition)

    def answer(x_c: Array, x_d: Array) -> tuple[Array, Array]:
        polished, _, _ = implicit_root(x_c, x_d, fields.skinning, transforms)
        return fields.geometry(polished, condition), polished

    logit, polished = jax.vmap(answer)(chosen, points)
    return Query(logit, polished, found)
