"""Recall at the borders of parts, for points without a part label.

Question: a point sampled around a vertex has the part of the vertex; a point in space has no part.
Does a search from the nearby parts find its root as often, at wrists, neck and mouth?

Points are sampled around canonical vertices within 3 cm of another part. The tabulated network maps
them to bodies posed as in `correspondence.py`, so the root of each point is known.

    python benchmarks/part_borders.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from correspondence import tabulated
from jaxtyping import Bool, Int
from measuring import print_rows, write_result
from scipy.spatial import cKDTree
from search_problems import FULL_PREFIT, NOISE_M, QUICK_PREFIT, carry, hard_pose, hits, paper_field

import xavatar_jax as xa
from xavatar_jax.correspondence import RowFinder, search_grid, start_table
from xavatar_jax.correspondence.starts import NEAR
from xavatar_jax.fields import grid_vertices, pose_grid
from xavatar_jax.report import describe_machine

BORDERS = {
    "wrists": (("body",), ("left_hand", "right_hand")),
    "neck and head": (("body",), ("face",)),
    "mouth and eyes": (("face",), ("eyes_mouth",)),
}


def at_border(
    vertices: np.ndarray, labels: Int[np.ndarray, " V"], one: tuple, other: tuple
) -> Bool[np.ndarray, " V"]:
    """Vertices of either side that are near the other side."""
    near = np.zeros(len(vertices), bool)
    for own, across in ((one, other), (other, one)):
        rows = np.flatnonzero(np.isin(labels, own))
        away, _ = cKDTree(vertices[np.isin(labels, across)]).query(vertices[rows])
        near[rows[away < NEAR]] = True
    return near


def main() -> None:
    parser = argparse.ArgumentParser(description="Recall at the borders of parts.")
    parser.add_argument("--quick", action="store_true", help="small run of a minute or two")
    parser.add_argument("--json", help="JSON file for header and rows")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache-dir")
    args = parser.parse_args()
    frames, count = (1, 300) if args.quick else (8, 3000)
    steps, grid_mm = (QUICK_PREFIT, (34, 8, 16)) if args.quick else (FULL_PREFIT, (16, 4, 8))
    body = xa.synthetic_body(args.cache_dir)
    vertices, labels = grid_vertices(body), np.asarray(body.part_labels)
    mlp = paper_field(body, steps, cache=args.cache_dir)
    field = tabulated(body, vertices, mlp, grid_mm, 1).grid
    pairs, full = start_table(body, pairs=True), start_table(body, "full")
    pose, rows = jax.jit(pose_grid), []
    for degrees in (20.0, 40.0):
        for name, sides in BORDERS.items():
            rng = np.random.default_rng([args.seed, 6])
            found: dict[str, list[np.ndarray]] = {}
            lanes: dict[str, int] = {}
            one, other = (tuple(map(body.parts.index, side)) for side in sides)
            spots = np.flatnonzero(at_border(vertices, labels, one, other))
            for _ in range(frames):
                params = xa.BodyParams.create(body, pose=hard_pose(body, rng, degrees))
                transforms = jnp.asarray(xa.bone_transforms(body, params), jnp.float32)
                posed = np.asarray(xa.pose_body(body, params).vertices)
                chosen = rng.choice(spots, count)
                x_c = vertices[chosen] + NOISE_M * rng.standard_normal((count, 3))
                x_d = carry(field, jnp.asarray(x_c, jnp.float32), transforms)
                nearest = labels[cKDTree(posed).query(np.asarray(x_d))[1]]
                grid = pose(field, transforms)
                for rule, row, table in (
                    ("its own part", labels[chosen], pairs),
                    ("part of the nearest vertex", nearest, pairs),
                    ("the parts within 3 cm", RowFinder(posed, body.parts)(np.asarray(x_d)), pairs),
                    ("full", labels[chosen], full),
                ):
                    roots = search_grid(grid, x_d, jnp.asarray(row, jnp.int32), transforms, table)
                    hit = hits(np.asarray(roots.x_c), np.asarray(roots.valid), x_c)
                    found.setdefault(rule, []).append(hit)
                    lanes[rule] = lanes.get(rule, 0) + int(roots.lanes)
            for rule, hit in found.items():
                rows.append(
                    {
                        "border": name,
                        "pose_deg": degrees,
                        "starts": rule,
                        "points": frames * count,
                        "recall": float(np.concatenate(hit).mean()),
                        "starts_per_point": lanes[rule] / (frames * count),
                    }
                )
    print_rows(rows, tuple(rows[0]))
    header = {
        "question": "recall at the borders of parts, with and without labels",
        **describe_machine(),
        "quick": args.quick,
        "seed": args.seed,
        "prefit_steps": steps,
        "grid_mm": grid_mm,
        "frames": frames,
    }
    write_result(args.json, header, rows)


if __name__ == "__main__":
    main()
