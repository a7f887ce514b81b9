"""Throughput and recall of all correspondence searches.

Questions: how many points per second does each search handle, by field, start set, pose range and
batch size? Does it find the known roots?

A *known* root is the canonical point that the field itself maps to the posed point. All searches
get the same frames, points and field. The reference path, one `optimistix.root_find` per start
under `vmap`, is the baseline; it runs on a subset of the points because it is slow.

    python benchmarks/correspondence.py [--quick] [--json FILE] [--picture FILE] [--tables NAME...]

Tables are written as they finish. `--tables` measures some of them and keeps the others in the
file.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from measuring import least_time, peak_rise_mb, print_rows, write_result
from resumable import rows_of
from search_problems import (
    FULL_PREFIT,
    QUICK_PREFIT,
    Problem,
    carry,
    hard_problems,
    hits,
    near_surface,
    paper_field,
    recall,
)
from self_contact import contact_points, contact_poses, inner_nodes, root_shares

import xavatar_jax as xa
from xavatar_jax.body import BodyModel
from xavatar_jax.correspondence import (
    Group,
    StartSet,
    StartTable,
    find_correspondences,
    part_groups,
    search_field,
    search_grid,
    start_table,
)
from xavatar_jax.correspondence.starts import groups_by_part
from xavatar_jax.fields import (
    AbstractSkinningField,
    GridSpacing,
    TabulatedSkinning,
    body_part_grids,
    grid_vertices,
    pose_grid,
    tabulate,
)
from xavatar_jax.render import grid_picture, save_png
from xavatar_jax.report import describe_machine, line_chart

# Points per tabulation and blending of transforms in `points_per_s_with_tables`.
SHARED_BY = 100_000
PATHS = (("plain", "mlp"), ("batched", "mlp"), ("guided", "mlp"), ("plain", "grid"), ("grid",) * 2)
COLUMNS = (
    *("path", "field", "starts", "pose_deg", "points", "points_per_s", "times_plain"),
    *("recall_all", "recall_hands", "residual_max_m", "starts_per_point", "compile_s"),
)


@dataclass(frozen=True)
class Size:
    """Size of the benchmark; spacings in mm for body, hands, face."""

    prefit_steps: int = FULL_PREFIT
    starts: tuple[StartSet, ...] = ("paper", "part_aware", "all_bones", "full", "body")
    degrees: tuple[float, ...] = (20.0, 40.0)
    frames: int = 4
    points: int = 6000
    plain_points: int = 600
    plain_grid: bool = True
    repeats: int = 2
    grid_mm: tuple[float, float, float] = (16, 4, 8)
    guide_mm: tuple[float, float, float] = (8, 3, 4)
    batches: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000, 1_000_000)
    slow_batches: tuple[int, ...] = (10_000, 30_000, 100_000)
    bones: tuple[int, ...] = (3, 9, 16, 30, 45)
    resolutions_mm: tuple[tuple[float, float, float], ...] = (
        *((34, 8, 16), (24, 6, 12), (16, 4, 8), (12, 4, 6), (8, 3, 4)),
    )
    contacts: tuple[str, ...] = ("hand on thigh", "palms together", "fists")
    contact_points: int = 200
    keep_contact: int = 6


QUICK = Size(
    prefit_steps=QUICK_PREFIT,
    starts=("paper",),
    degrees=(20.0,),
    frames=2,
    points=1200,
    plain_points=120,
    plain_grid=False,
    repeats=1,
    grid_mm=(34, 8, 16),
    guide_mm=(34, 8, 16),
    batches=(10_000, 40_000),
    slow_batches=(),
    bones=(),
    resolutions_mm=(),
    contacts=("fists",),
    contact_points=60,
)


class Fields(NamedTuple):
    """The network, its tabulation (a field or a guide), and the seconds these took."""

    mlp: AbstractSkinningField
    grid: TabulatedSkinning
    tabulate_s: float
    pose_s: float


class Search(NamedTuple):
    """A compiled search, the seconds to compile it, and its temporary memory."""

    run: Callable[[Problem], Any]
    compile_s: float
    temporary_mb: float | None


def tabulated(
    body: BodyModel, vertices: np.ndarray, mlp: AbstractSkinningField, mm: tuple, repeats: int = 2
) -> Fields:
    """Tabulate the network on grids of a spacing, timed after compilation."""
    spacing = GridSpacing(body=mm[0] / 1e3, hands=mm[1] / 1e3, face=mm[2] / 1e3)
    grids = body_part_grids(body, vertices, spacing)
    table = eqx.filter_jit(tabulate)
    grid, seconds = least_time(lambda: table(mlp, grids), repeats)
    pose = jax.jit(pose_grid)
    still = jnp.broadcast_to(jnp.eye(4), (body.num_joints, 4, 4))
    _, pose_s = least_time(lambda: pose(grid, still), repeats + 1)
    return Fields(mlp, grid, seconds, pose_s)


def compiled(
    path: str, field: AbstractSkinningField, fields: Fields, table: StartTable, first: Problem
) -> Search:
    """Compile a search for problems of the size of `first`; posing the guide is not timed."""
    pose = jax.jit(pose_grid)
    clock = time.perf_counter()
    if path == "grid":
        grid = pose(fields.grid, first.transforms)
        program = search_grid.lower(grid, first.x_d, first.parts, first.transforms, table).compile()
        memory = program.memory_analysis()

        def run(p: Problem) -> Any:
            posed = jax.block_until_ready(pose(fields.grid, p.transforms))
            return lambda: program(posed, p.x_d, p.parts, p.transforms, table)
    else:
        guide = pose(fields.grid, first.transforms) if path == "guided" else None
        given = {} if guide is None else {"guide": guide}
        lowered = cast(Any, search_field).lower(
            field, first.x_d, first.parts, first.transforms, table, **given
        )
        program = lowered.compile()
        memory = program.compiled.memory_analysis()

        def run(p: Problem) -> Any:
            more = {}
            if path == "guided":
                more = {"guide": jax.block_until_ready(pose(fields.grid, p.transforms))}
            return lambda: program(field, p.x_d, p.parts, p.transforms, table, **more)

    seconds = time.perf_counter() - clock
    return Search(run, seconds, memory.temp_size_in_bytes / 2**20 if memory else None)


@eqx.filter_jit
def _plain(field: AbstractSkinningField, x_d: Array, transforms: Array, bones: tuple) -> Any:
    found = jax.vmap(
        lambda x: find_correspondences(x, field, transforms, init_bones=bones, adjoint=None)
    )(x_d)
    return found.x_c, found.found, found.residual, found.num_steps


def plain_row(
    body: BodyModel,
    field: AbstractSkinningField,
    problems: list[Problem],
    starts: StartSet,
    size: Size,
) -> tuple[dict[str, Any], np.ndarray]:
    """Metrics of the reference path on a subset of the points, and a mask of this subset.

    The reference path runs part by part and starts at bones only.
    """
    # Search the points of each group together.
    of_part = [group.bones for group in groups_by_part(body, starts).values()]
    spent, compile_s, lanes, steps = 0.0, 0.0, 0, 0
    hit, parts, residuals = [], [], []
    asked = np.zeros((len(problems), size.points), bool)
    for k, p in enumerate(problems):
        labels = np.asarray(p.parts)
        every = size.points // size.plain_points
        for bones in sorted(set(of_part)):
            own = [c for c, b in enumerate(of_part) if b == bones]
            rows = np.flatnonzero(np.isin(labels, own))[::every]
            if not len(rows):
                continue
            asked[k, rows] = True
            x_d, x_c = p.x_d[rows], np.asarray(p.x_c)[rows]
            run = lambda x=x_d, t=p.transforms, b=bones: _plain(field, x, t, b)  # noqa: E731
            if k == 0:
                _, first_s = least_time(run, 1)
                compile_s += first_s
            (points, found, residual, count), seconds = least_time(run, 1)
            spent += seconds
            lanes, steps = lanes + count.size, steps + int(count.sum())
            hit.append(hits(points, found, x_c))
            parts.append(labels[rows])
            residuals.append(np.asarray(residual)[np.asarray(found)])
    measured = {
        "points": len(np.concatenate(hit)) // len(problems),
        "points_per_s": len(np.concatenate(hit)) / spent,
        **recall(np.concatenate(hit), np.concatenate(parts)),
        "recall_plain_points": float(np.concatenate(hit).mean()),
        "residual_max_m": float(np.concatenate(residuals).max()),
        "residual_median_m": float(np.median(np.concatenate(residuals))),
        "steps_per_start": steps / lanes,
        "starts_per_point": lanes / len(np.concatenate(hit)),
        "compile_s": compile_s - spent / len(problems),
    }
    return measured, asked.reshape(-1)


def fast_row(
    search: Search,
    problems: list[Problem],
    fields: Fields,
    path: str,
    repeats: int,
    asked: np.ndarray | None = None,
) -> dict[str, Any]:
    """A compiled search on whole frames; `asked` marks the points of the reference path."""
    spent, lanes, steps = 0.0, 0, 0
    hit, parts, residuals, peak = [], [], [], None
    for k, p in enumerate(problems):
        run = search.run(p)
        if k == 0:
            peak = peak_rise_mb(lambda run=run: jax.block_until_ready(run()))
        roots, seconds = least_time(run, repeats)
        spent += seconds
        lanes, steps = lanes + int(roots.lanes), steps + int(roots.steps)
        hit.append(hits(np.asarray(roots.x_c), np.asarray(roots.valid), np.asarray(p.x_c)))
        parts.append(np.asarray(p.parts))
        residuals.append(np.asarray(roots.residual)[np.asarray(roots.valid)])
    found = np.concatenate(hit)
    each = spent / len(found)
    tables = 0.0 if path == "batched" else (fields.tabulate_s + fields.pose_s) / SHARED_BY
    return {
        "points": len(found) // len(problems),
        "points_per_s": 1 / each,
        "points_per_s_with_tables": 1 / (each + tables),
        **recall(found, np.concatenate(parts)),
        **({} if asked is None else {"recall_plain_points": float(found[asked].mean())}),
        "residual_max_m": float(np.concatenate(residuals).max()),
        "residual_median_m": float(np.median(np.concatenate(residuals))),
        "steps_per_start": steps / lanes,
        "starts_per_point": lanes / len(found),
        "compile_s": search.compile_s,
        "temporary_mb": search.temporary_mb,
        "rss_rise_mb": peak,
    }


def paths_table(
    body: BodyModel, vertices: np.ndarray, fields: Fields, guides: Fields, size: Size, seed: int
) -> list[dict[str, Any]]:
    """Paths x fields x start sets x pose range."""
    problems = {
        (name, degrees): hard_problems(
            body,
            getattr(fields, name),
            vertices,
            degrees=degrees,
            frames=size.frames,
            count=size.points,
            seed=seed,
        )
        for name in ("mlp", "grid")
        for degrees in size.degrees
    }
    rows, asked = [], {}
    for starts in size.starts:
        # Compiled programs use memory maps, and a process can have about 65,000.
        jax.clear_caches()
        table = start_table(body, starts)
        for path, name in PATHS:
            if path == "plain" and name == "grid" and not size.plain_grid:
                continue
            field, search = getattr(fields, name), None
            tables = guides if path == "guided" else fields
            for degrees in size.degrees:
                cases, case = problems[name, degrees], (name, starts, degrees)
                if path == "plain":
                    measured, asked[case] = plain_row(body, field, cases, starts, size)
                else:
                    search = search or compiled(path, field, tables, table, cases[0])
                    repeats = 1 if path == "batched" else size.repeats
                    measured = fast_row(search, cases, tables, path, repeats, asked.get(case))
                label = {"path": path, "field": name, "starts": starts, "pose_deg": degrees}
                rows.append({"table": "paths", **label, **measured})
                print_rows(rows[-1:], COLUMNS)
    # Relative to the reference path on the network with the same starts.
    plain = {
        (r["starts"], r["pose_deg"]): r["points_per_s"]
        for r in rows
        if (r["path"], r["field"]) == ("plain", "mlp")
    }
    for row in rows:
        rate = row.get("points_per_s_with_tables", row["points_per_s"])
        row["times_plain"] = rate / plain[row["starts"], row["pose_deg"]]
    return rows


def one_frame(
    body: BodyModel, vertices: np.ndarray, field: Any, transforms: Array, count: int, seed: int
) -> Problem:
    """Many points of one frame."""
    rng = np.random.default_rng([seed, 3])
    x_c, parts = near_surface(vertices, np.asarray(body.part_labels), count, rng)
    x_c = jnp.asarray(x_c)
    return Problem(x_c, jnp.asarray(parts), carry(field, x_c, transforms), transforms)


def batch_table(
    body: BodyModel, vertices: np.ndarray, fields: Fields, guides: Fields, size: Size, seed: int
) -> list[dict[str, Any]]:
    """Throughput and memory by number of points per call."""
    table = start_table(body, "part_aware")
    transforms = hard_problems(
        body, fields.grid, vertices, degrees=20.0, frames=1, count=60, seed=seed
    )[0].transforms
    rows = []
    for path, name in PATHS:
        if path == "plain":
            continue
        counts = size.batches if path == "grid" or size.slow_batches else ()
        for count in size.slow_batches if path == "batched" else counts:
            field, tables = getattr(fields, name), guides if path == "guided" else fields
            case = one_frame(body, vertices, field, transforms, count, seed)
            search = compiled(path, field, tables, table, case)
            # Repeat small batches more often, since load on the machine affects them more.
            often = max(size.repeats, size.repeats * 100_000 // count)
            row = fast_row(search, [case], tables, path, 1 if path == "batched" else often)
            label = {"path": path, "field": name, "starts": "part_aware", "pose_deg": 20.0}
            rows.append({"table": "batches", **label, **row})
            print_rows(rows[-1:], COLUMNS)
    return rows


def bones_table(
    body: BodyModel, vertices: np.ndarray, fields: Fields, guides: Fields, size: Size, seed: int
) -> list[dict[str, Any]]:
    """Throughput by number of start bones per point."""
    every = part_groups(body.tree, "paper")["full"].bones
    rows = []
    for path, name in (("guided", "mlp"), ("grid", "grid")):
        tables = guides if path == "guided" else fields
        cases = hard_problems(
            body, getattr(fields, name), vertices,
            degrees=20.0, frames=2, count=size.points, seed=seed,
        )  # fmt: skip
        for count in size.bones:
            table = start_table(body, "all_bones", {"full": Group(every[:count])})
            search = compiled(path, getattr(fields, name), tables, table, cases[0])
            row = fast_row(search, cases, tables, path, size.repeats)
            label = {"path": path, "field": name, "starts": f"{count} bones", "pose_deg": 20.0}
            rows.append({"table": "bones", "bones": count, **label, **row})
            print_rows(rows[-1:], COLUMNS)
    return rows


def resolution_table(
    body: BodyModel, vertices: np.ndarray, fields: Fields, guides: Fields, size: Size, seed: int
) -> list[dict[str, Any]]:
    """Cost of a grid by spacing, and its distance from the network."""
    del guides  # each row has its own
    mlp, table, rows = fields.mlp, start_table(body, "part_aware"), []
    weigh = eqx.filter_jit(lambda field, x: jax.vmap(field)(x))
    for mm in size.resolutions_mm:
        fields = tabulated(body, vertices, mlp, mm)
        cases = hard_problems(
            body, fields.grid, vertices, degrees=20.0, frames=2, count=size.points, seed=seed
        )
        own = hard_problems(
            body, mlp, vertices, degrees=20.0, frames=2, count=size.points, seed=seed
        )
        x_c, parts = near_surface(
            vertices, np.asarray(body.part_labels), size.points, np.random.default_rng(seed)
        )
        gap = 0.5 * np.abs(np.asarray(weigh(mlp, x_c)) - np.asarray(weigh(fields.grid, x_c)))
        moved = np.concatenate(
            [
                np.linalg.norm(np.asarray(carry(fields.grid, p.x_c, p.transforms) - p.x_d), axis=1)
                for p in own
            ]
        )
        label = dict(zip(("body_mm", "hands_mm", "face_mm"), mm, strict=True))
        grid = fast_row(compiled("grid", fields.grid, fields, table, cases[0]),
                        cases, fields, "grid", size.repeats)  # fmt: skip
        guided = fast_row(compiled("guided", mlp, fields, table, own[0]),
                          own, fields, "guided", 1)  # fmt: skip
        hands = np.isin(parts, body.parts.members("hands"))
        rows.append(
            {
                "table": "resolution",
                **label,
                "nodes": fields.grid.grids.num_nodes,
                "table_mb": fields.grid.node_weights.nbytes / 2**20,
                "tabulate_s": fields.tabulate_s,
                "pose_s": fields.pose_s,
                "weight_error_mean": float(gap.sum(1).mean()),
                "weight_error_hands_mean": float(gap[hands].sum(1).mean()),
                "weight_error_p99": float(np.quantile(gap.sum(1), 0.99)),
                "posed_error_median_mm": 1e3 * float(np.median(moved)),
                "posed_error_p99_mm": 1e3 * float(np.quantile(moved, 0.99)),
                "grid_points_per_s": grid["points_per_s"],
                "grid_points_per_s_with_tables": grid["points_per_s_with_tables"],
                "grid_recall_all": grid["recall_all"],
                "grid_recall_hands": grid["recall_hands"],
                "guided_points_per_s": guided["points_per_s"],
                "guided_recall_all": guided["recall_all"],
                "guided_recall_hands": guided["recall_hands"],
            }
        )
        print_rows(rows[-1:], tuple(rows[-1])[1:])
    return rows


def contact_table(
    body: BodyModel, vertices: np.ndarray, fields: Fields, guides: Fields, size: Size, seed: int
) -> list[dict[str, Any]]:
    """Recall of all roots where the body touches itself."""
    poses = contact_poses(body, vertices, size.contacts)
    nodes = inner_nodes(body, vertices, fields.grid.grids)
    tables = (
        ("full", start_table(body, "full"), "label"),
        ("all_bones", start_table(body, "all_bones"), "label"),
        ("part_aware", start_table(body, "part_aware"), "label"),
        ("part_aware, both parts", start_table(body, "part_aware", pairs=True), "pair_row"),
        ("paper, both parts", start_table(body, "paper", pairs=True), "pair_row"),
    )
    paths = (("grid", "grid"), ("guided", "mlp"), ("batched", "mlp"))
    pose = jax.jit(pose_grid)
    rows = []
    for name, params in poses.items():
        jax.clear_caches()
        made: dict[str, Any] = {}
        for path, of in paths if size.plain_grid else paths[:1]:
            field = getattr(fields, of)
            if of not in made:
                made[of] = contact_points(
                    name, params, body, field, vertices, nodes,
                    count=size.contact_points, seed=seed,
                )  # fmt: skip
            for starts, table, row_of in tables:

                def search(x: Array, part: Array, transforms: Array, path=path, t=table, f=field):
                    keep = size.keep_contact
                    if path == "grid":
                        roots = search_grid(
                            pose(fields.grid, transforms), x, part, transforms, t, keep=keep
                        )
                    else:
                        guide = pose(guides.grid, transforms) if path == "guided" else None
                        roots = search_field(f, x, part, transforms, t, guide=guide, keep=keep)
                    return np.asarray(roots.x_c), np.asarray(roots.valid)

                shares = root_shares(made[of], search, getattr(made[of], row_of))
                label = {"case": name, "path": path, "field": of, "starts": starts}
                rows.append({"table": "contact", **label, **shares})
                print_rows(rows[-1:], tuple(rows[-1])[1:])
    return rows


TABLES = {
    "paths": paths_table,
    "batches": batch_table,
    "bones": bones_table,
    "resolution": resolution_table,
    "contact": contact_table,
}


def draw(rows: list[dict[str, Any]], path: str) -> None:
    """Draw throughput by batch size and by number of bones."""
    names = {"grid": "grid field", "guided": "network, guided by the grid", "batched": "network"}
    batches, bones = {}, {}
    for row in rows:
        if row["table"] == "batches":
            batches.setdefault(names[row["path"]], []).append((row["points"], row["points_per_s"]))
        if row["table"] == "bones":
            bones.setdefault(names[row["path"]], []).append((row["bones"], row["points_per_s"]))
    for row in rows:
        count = {"body": 9, "all_bones": 45}.get(row.get("starts", ""))
        measured = (row["table"], row.get("path"), row.get("field"), row.get("pose_deg"))
        if bones and count and measured == ("paths", "plain", "mlp", 20.0):
            bones.setdefault("network, reference path", []).append((count, row["points_per_s"]))
    bones = {name: sorted(line) for name, line in bones.items()}
    charts = []
    if batches:
        ticks = sorted({p[0] for line in batches.values() for p in line})
        charts.append(
            line_chart(batches, title="points/s", x_label="points per call", x_ticks=ticks)
        )
    if bones:
        ticks = sorted({p[0] for line in bones.values() for p in line})
        charts.append(
            line_chart(bones, title="points/s", x_label="start bones per point", x_ticks=ticks)
        )
    save_png(path, grid_picture([charts]))


def main() -> None:
    parser = argparse.ArgumentParser(description="Correspondence search: throughput and recall.")
    parser.add_argument("--quick", action="store_true", help="small run of a minute or two")
    parser.add_argument("--json", help="JSON file for header and rows")
    parser.add_argument("--picture", help="PNG file for the chart")
    names = ", ".join(TABLES)
    parser.add_argument("--tables", nargs="+", choices=TABLES, metavar="NAME",
                        help=f"tables to measure ({names}); others are kept")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--prefit-steps", type=int, help="number of steps to fit the network")
    parser.add_argument("--cache-dir")
    args = parser.parse_args()
    size = QUICK if args.quick else Size()
    steps = args.prefit_steps or size.prefit_steps
    body = xa.synthetic_body(args.cache_dir)
    vertices = grid_vertices(body)
    mlp = paper_field(body, steps, cache=args.cache_dir)
    fields = tabulated(body, vertices, mlp, size.grid_mm)
    guides = tabulated(body, vertices, mlp, size.guide_mm)
    header = {
        "question": "throughput and recall of the searches",
        **describe_machine(),
        "quick": args.quick,
        "seed": args.seed,
        **asdict(size),
        "prefit_steps": steps,
        "pose_law": "normal, pose_deg rms per axis on every joint, 0.3 of it on pelvis and spine",
        "point_law": "3/6 body, 1/6 face, 1/6 each hand; 5 mm rms per axis around the mean shape",
        "tabulate_s": fields.tabulate_s,
        "pose_s": fields.pose_s,
        "guide_tabulate_s": guides.tabulate_s,
        "guide_pose_s": guides.pose_s,
        "tables_shared_by_points": SHARED_BY,
        "grid_nodes": fields.grid.grids.num_nodes,
        "guide_nodes": guides.grid.grids.num_nodes,
    }
    rows: list[dict[str, Any]] = []
    if args.tables and args.json and Path(args.json).exists():
        same = ("device", "cores", "quick", "seed", "prefit_steps", *asdict(size))
        rows = rows_of(Path(args.json), header, same)
    for name in args.tables or TABLES:
        jax.clear_caches()
        measured = TABLES[name](body, vertices, fields, guides, size, args.seed)
        rows = [row for row in rows if row["table"] != name]
        rows += [{**row, "commit": header["commit"]} for row in measured]
        if args.json:
            header["peak_rss_mb"] = describe_machine()["peak_rss_mb"]
            write_result(args.json, header, rows)
    if args.picture:
        draw(rows, args.picture)
        print(f"written: {args.picture}")


if __name__ == "__main__":
    main()
