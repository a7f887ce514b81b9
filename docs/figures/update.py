"""Store measured results and generate the tables of README and docs from them.

    python docs/figures/update.py                                    # regenerate the tables
    python docs/figures/update.py --metrics out/fit_grab/metrics.json
    python docs/figures/update.py --part-aware part_aware.json
    python docs/figures/update.py --animate animate.json --view view.json
    python docs/figures/update.py --correspondence search.json --gradients gradients.json
    python docs/figures/update.py --borders borders.json
    python docs/figures/update.py --table1 table1.json --table2 table2.json --curve curve.json

Results are copied into this folder without paths and per-frame values. A generated table is
enclosed by `<!-- figures: FILE VIEW -->` and `<!-- end of figures -->`. The table of presets is
read from the library.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "figures"
sys.path.append(str(ROOT / "benchmarks"))
TEXTS = (
    "README.md",
    "docs/animate-and-export.md",
    "docs/benchmarks.md",
    "docs/choose.md",
    "docs/options.md",
    "docs/view-and-render.md",
)
METRICS, SEEDS, PART_AWARE = "metrics.json", "metrics_seeds.json", "part_aware_vs_all_bones.json"
ANIMATE, VIEW = "animate.json", "view_and_render.json"
PAPER, SURFACE = "metrics_paper.json", "surface_paper.json"
SEARCH, GRADIENTS = "correspondence.json", "gradients.json"
BORDERS = "part_borders.json"
FLOOR = "metric_floor.json"
MEMORY = "memory.json"
TABLE1, TABLE2, CURVE = "table1_ablations.json", "table2_grab.json", "accuracy_over_time.json"
REGIONS = ("all", "hands", "face")
NOT_MEASURED = "Not measured yet for this version."

_FIGURES = (
    ("cd_mm", "Chamfer distance, mm", 2),
    ("cd_max_mm", "maximum distance, mm", 1),
    ("nc", "normal consistency", 3),
    ("iou", "volumetric IoU", 3),
    ("iou_near", "volumetric IoU near the surface", 3),
    ("iou_box", "bounding-box IoU", 3),
)
_KEPT = (
    *(name for name, _, _ in _FIGURES),
    *("count", "before", "frames", "seconds", "stages", "preset", "seed", "steps"),
    *("by_pose_distance", "training"),
    *("device", "cores", "peak_rss_mb", "commit", "versions"),
)
_ENTRIES = (
    ("steps", "{}"),
    ("train_frames", "{} (0: all)"),
    ("frames_per_step", "{}"),
    ("points_per_step", "{}, per frame"),
    ("points.total", "{}, drawn per frame"),
    ("skinning.kind", "{}"),
    ("geometry.kind", "{}"),
    ("search.starts", "{}"),
    ("search.cached", "{}"),
    ("search.keep", "{}, roots per point"),
    ("losses.softness", "{}, metres"),
    ("losses.bone", "{}"),
    ("losses.joint", "{}"),
    ("losses.surface", "{}"),
    ("losses.surface_parts", "{}"),
    ("optimiser.learning_rate", "{}"),
    ("optimiser.skinning_rate", "{}"),
    ("optimiser.schedule", "{}"),
    ("optimiser.clip", "{}"),
    ("optimiser.warmup", "{}, steps"),
    ("validation.every", "{}, steps"),
    ("validation.patience", "{}, steps"),
    ("prefit_steps", "{}"),
    ("weights_steps", "{}"),
)
_SEARCH = (
    ("search_points_per_s", "search, points/s", 0),
    ("starts_per_point", "starts per point", 1),
    ("steps_per_start", "solver steps per start", 1),
    ("recall_all", "recall of known correspondences, all", 4),
    ("recall_body", "recall, body", 4),
    ("recall_face", "recall, face", 4),
    ("recall_hands", "recall, hands", 4),
    ("train_steps_per_s", "training, steps/s", 3),
    ("cd_all_mm", "equal steps: Chamfer, all, mm", 2),
    ("cd_hands_mm", "equal steps: Chamfer, hands, mm", 2),
    ("cd_face_mm", "equal steps: Chamfer, face, mm", 2),
    ("equal_time_steps", "equal time: steps", 0),
    ("equal_time_cd_all_mm", "equal time: Chamfer, all, mm", 2),
    ("equal_time_cd_hands_mm", "equal time: Chamfer, hands, mm", 2),
)
_ANIMATE = (
    ("frames_per_s", "frames/s", 1),
    ("processor_ms_per_frame", "CPU time per frame, ms", 1),
    ("vertex_mean_mm", "vertex-to-vertex error, mean, mm", 3),
    ("vertex_p99_mm", "vertex-to-vertex error, 99th percentile, mm", 2),
    ("surface_mean_mm", "vertex-to-surface error, mean, mm", 3),
    ("surface_p99_mm", "vertex-to-surface error, 99th percentile, mm", 2),
    ("surface_max_mm", "vertex-to-surface error, maximum, mm", 1),
)
_EXPORT = (
    ("seconds", "time, s", 1),
    ("megabytes", "size, MB", 1),
    ("influences_mean_mm", "error from dropped bones, mean, mm", 3),
    ("influences_max_mm", "error from dropped bones, maximum, mm", 2),
    ("rig_mean_mm", "total error, mean, mm", 3),
    ("rig_max_mm", "total error, maximum, mm", 1),
)
_EXTRACTION_COLUMNS = (
    ("vertices", "vertices", 0),
    ("seconds", "s", 1),
    ("first_s", "first call, s", 1),
    ("rss_rise_mb", "memory increase, MiB", 0),
)
_SECONDS_COLUMNS = (("seconds", "s", 2), ("processor_s", "CPU time, s", 2))


def slim_metrics(record: dict[str, Any]) -> dict[str, Any]:
    """The stored part of a run's `metrics.json`."""
    return {name: record[name] for name in _KEPT if name in record}


def slim_benchmark(record: dict[str, Any]) -> dict[str, Any]:
    """The stored part of a benchmark's JSON."""
    header = {name: value for name, value in record["header"].items() if name != "platform"}
    return {"header": header, "rows": record["rows"]}


def accuracy_view(record: dict[str, Any]) -> str:
    """Held-out metrics before and after training, with the setup of the run."""
    before = record["before"]
    head = [f"{record['frames']} held-out frames"]
    for region in REGIONS:
        head += [f"{region}", "before"]
    rows = [head]
    for name, label, digits in _FIGURES:
        row = [label]
        for region in REGIONS:
            row += [f"**{_number(record[name][region], digits)}**"]
            row += [_number(before[name][region], digits)]
        rows.append(row)
    few = round(record["frames"] * before["count"]["all"] / record["count"]["all"])
    return (
        f"{_table(rows)}\n\n"
        f"Preset `{record['preset']}`, {record['steps']} steps, seed {record['seed']}, "
        f"{_machine(record)}: {record['seconds']['total']:.0f} s in total, "
        f"{record['peak_rss_mb'] / 1024:.1f} GiB peak memory. "
        f"*Before*: the body's mean shape on the person's skeleton, before training, "
        f"on {few} of the frames."
    )


def seeds_view(record: dict[str, Any]) -> str:
    """Median, minimum and maximum over seeds."""
    runs = record["runs"]
    rows = [[f"{len(runs)} seeds", *REGIONS]]
    for name, label, digits in _FIGURES:
        row = [label]
        for region in REGIONS:
            values = sorted(run[name][region] for run in runs)
            low, middle, high = (
                _number(v, digits) for v in (values[0], median(values), values[-1])
            )
            row.append(f"{middle} ({low} to {high})")
        rows.append(row)
    seeds = ", ".join(str(run["seed"]) for run in runs)
    seconds = sorted(run["seconds"]["total"] for run in runs)
    return (
        f"{_table(rows)}\n\n{_sentence(_machine(runs[0]))}; seeds {seeds}, {seconds[0]:.0f} to "
        f"{seconds[-1]:.0f} s in total."
    )


def paper_view(record: dict[str, Any]) -> str:
    """Metrics after a few steps of `paper`, with an estimate of the time of the full schedule."""
    import xavatar_jax as xa

    steps = xa.paper().steps
    seconds = record["stages"]["train"] / record["steps"]
    return (
        f"{accuracy_view(record)} A step takes {seconds:.0f} s, so the full schedule of {steps:,} "
        f"steps would take {steps * seconds / 3600:.0f} hours."
    )


def stages_view(record: dict[str, Any]) -> str:
    """Seconds per stage."""
    rows = [["stage", "seconds"]]
    rows += [[name, f"{value:.0f}"] for name, value in record["seconds"].items()]
    return f"{_table(rows)}\n\n{_sentence(_machine(record))}."


def distance_view(record: dict[str, Any]) -> str:
    """Held-out metrics grouped by distance to the nearest training pose."""
    if "by_pose_distance" not in record:
        return NOT_MEASURED
    rows = [["", "degrees", "frames", *(f"Chamfer, {region}, mm" for region in REGIONS)]]
    for name, group in record["by_pose_distance"].items():
        low, high = group["pose_distance_deg"]
        figures = [_number(group["cd_mm"][region], 2) for region in REGIONS]
        rows.append([name, f"{low:.1f} to {high:.1f}", str(group["frames"]), *figures])
    return f"{_table(rows)}\n\n{_sentence(_machine(record))}."


def benchmark_view(record: dict[str, Any]) -> str:
    """One column per start set."""
    columns = record["rows"]
    rows = [["", *(column["starts"] for column in columns)]]
    for name, label, digits in _SEARCH:
        rows.append([label, *(_number(column[name], digits) for column in columns)])
    header = record["header"]
    size = "quick" if header["quick"] else "full"
    return (
        f"{_table(rows)}\n\n{_sentence(_machine(header))}; {size} run, seed {header['seed']}, "
        f"{header['points_per_step']} points per training step; equal time: "
        f"{header['equal_time_s']:.0f} s of training."
    )


def animate_view(record: dict[str, Any]) -> str:
    """One column per value of `offsets`."""
    columns, header = record["rows"], record["header"]
    rows = [["`offsets`", *(f"`{column['offsets']}`" for column in columns)]]
    for name, label, digits in _ANIMATE:
        values = (_number(column.get(name), digits) for column in columns)
        rows.append([label, *(value if value != "not measured" else "-" for value in values)])
    return (
        f"{_table(rows)}\n\n{_sentence(_machine(header))}; preset `{header['preset']}`, "
        f"{header['vertices']} vertices, {header['frames']} frames. Once per avatar: "
        f"{header['extraction_s']:.1f} s to extract the neutral surface and "
        f"{header['base_s']:.1f} s to cache its features."
    )


def export_view(record: dict[str, Any]) -> str:
    """One column per number of influences."""
    exports, header = record["header"]["exports"], record["header"]
    rows = [["influences per vertex", *(str(export["influences"]) for export in exports)]]
    for name, label, digits in _EXPORT:
        rows.append([label, *(_number(export[name], digits) for export in exports)])
    return f"{_table(rows)}\n\n{_sentence(_machine(header))}; {header['frames']} frames."


def extraction_view(record: dict[str, Any]) -> str:
    """Extraction of the canonical surface at several cell sizes."""
    header = record["header"]
    rows = [["cells", *(label for _, label, _ in _EXTRACTION_COLUMNS)]]
    rows += [[row["cells"], *_cells(row, _EXTRACTION_COLUMNS)] for row in header["extractions"]]
    return f"{_table(rows)}\n\n{_sentence(_machine(header))}; preset `{header['preset']}`."


def seconds_view(record: dict[str, Any]) -> str:
    """Seconds per task."""
    rows = [["", *(label for _, label, _ in _SECONDS_COLUMNS)]]
    rows += [[row["what"], *_cells(row, _SECONDS_COLUMNS)] for row in record["rows"]]
    header = record["header"]
    return f"{_table(rows)}\n\n{_sentence(_machine(header))}; {header['vertices']} vertices."


_PATHS = {
    ("plain", "mlp"): "network, reference path",
    ("batched", "mlp"): "network, batched",
    ("guided", "mlp"): "network, guided by the grid",
    ("plain", "grid"): "grid, reference path",
    ("grid", "grid"): "grid",
}
_PATH_COLUMNS = (
    ("points_per_s", "points/s", 0),
    ("points_per_s_with_tables", "with tables", 0),
    ("times_plain", "speed-up", 1),
    ("recall_all", "recall, all", 4),
    ("recall_body", "body", 4),
    ("recall_face", "face", 4),
    ("recall_hands", "hands", 4),
    ("recall_plain_points", "recall, reference points", 4),
    ("residual_max_um", "largest residual, µm", 1),
    ("steps_per_start", "steps per start", 1),
    ("starts_per_point", "starts per point", 1),
    ("compile_s", "compile, s", 1),
)
_BATCH_COLUMNS = (
    ("points", "points per call", 0),
    ("points_per_s", "points/s", 0),
    ("cost_ratio", "cost per point, relative", 2),
    ("temporary_mb", "temporary memory, MiB", 0),
    ("rss_rise_mb", "increase of resident memory, MiB", 0),
)
_RESOLUTION_COLUMNS = (
    ("nodes", "nodes", 0),
    ("table_mb", "table, MiB", 0),
    ("tabulate_s", "tabulate, s", 1),
    ("weight_error_mean", "weight error", 4),
    ("weight_error_hands_mean", "hands", 4),
    ("posed_error_median_mm", "posed error, median, mm", 2),
    ("posed_error_p99_mm", "99 %", 1),
    ("grid_points_per_s", "grid, points/s", 0),
    ("grid_recall_all", "grid, recall", 4),
    ("guided_points_per_s", "guided, points/s", 0),
    ("guided_recall_all", "guided, recall", 4),
    ("guided_recall_hands", "hands", 4),
)
_CONTACT_COLUMNS = (
    ("points", "points", 0),
    ("roots_per_point", "roots per point", 2),
    ("share_of_points_with_every_root", "points with all roots", 4),
    ("share_of_roots", "roots found", 4),
    ("inverted_roots_per_point", "inverted roots per point", 2),
    ("share_of_points_with_inverted_roots_too", "points with all roots, inverted ones included", 4),
)
_BORDER_COLUMNS = (
    ("pose_deg", "degrees", 0),
    ("points", "points", 0),
    ("recall", "recall", 4),
    ("starts_per_point", "starts per point", 1),
)


def paths_view(degrees: float) -> Callable[[dict[str, Any]], str]:
    """Paths, fields and start sets at one pose range."""

    def view(record: dict[str, Any]) -> str:
        rows = [["path", "starts", *(label for _, label, _ in _PATH_COLUMNS)]]
        for row in _of_table(record, "paths"):
            if row["pose_deg"] == degrees:
                row = {**row, "residual_max_um": 1e6 * row["residual_max_m"]}
                name = _PATHS[row["path"], row["field"]]
                rows.append([name, f"`{row['starts']}`", *_cells(row, _PATH_COLUMNS)])
        return _with_run(rows, record)

    return view


def batches_view(record: dict[str, Any]) -> str:
    """Cost per point and memory by batch size."""
    rows = [["path", *(label for _, label, _ in _BATCH_COLUMNS)]]
    found = _of_table(record, "batches")
    best: dict[str, float] = {}
    for row in found:
        best[row["path"]] = max(best.get(row["path"], 0.0), row["points_per_s"])
    for row in found:
        row = {**row, "cost_ratio": best[row["path"]] / row["points_per_s"]}
        rows.append([_PATHS[row["path"], row["field"]], *_cells(row, _BATCH_COLUMNS)])
    return _with_run(rows, record)


def resolution_view(record: dict[str, Any]) -> str:
    """Grids of several spacings compared with the network they tabulate."""
    rows = [["body, hands, face, mm", *(label for _, label, _ in _RESOLUTION_COLUMNS)]]
    for row in _of_table(record, "resolution"):
        spacing = ", ".join(f"{row[f'{name}_mm']:g}" for name in ("body", "hands", "face"))
        rows.append([spacing, *_cells(row, _RESOLUTION_COLUMNS)])
    return _with_run(rows, record)


def contact_view(record: dict[str, Any]) -> str:
    """Recall of all roots where a body touches itself."""
    rows = [["case", "path", "starts", *(label for _, label, _ in _CONTACT_COLUMNS)]]
    for row in _of_table(record, "contact"):
        name = _PATHS[row["path"], row["field"]]
        rows.append([row["case"], name, row["starts"], *_cells(row, _CONTACT_COLUMNS)])
    return _with_run(rows, record)


def borders_view(record: dict[str, Any]) -> str:
    """Recall at the borders of parts, by choice of start set."""
    rows = [["border", "start set", *(label for _, label, _ in _BORDER_COLUMNS)]]
    for row in record["rows"]:
        rows.append([row["border"], row["starts"], *_cells(row, _BORDER_COLUMNS)])
    return _with_run(rows, record)


def accuracy_of_gradients_view(record: dict[str, Any]) -> str:
    """Errors relative to finite differences."""
    rows = [["method", "w.r.t.", "mode", "largest error", "median", "below 1e-5"]]
    for row in _of_table(record, "accuracy"):
        errors = (f"{row[name]:.1e}" for name in ("relative_error_max", "relative_error_median"))
        share = f"{row['share_below_1e-5']:.4f}"
        rows.append([row["method"], row["by"], row["mode"], *errors, share])
    header = record["header"]
    return (
        f"{_with_run(rows, record)[:-1]}; {header['regular_points']} of {header['points']} points "
        f"have a determinant of at least {header['min_determinant']}."
    )


def float32_view(record: dict[str, Any]) -> str:
    """Derivatives in float32 compared with float64."""
    rows = [["roots", "w.r.t.", "mode", "largest gap", "99 %", "median", "below 1e-3"]]
    for row in _of_table(record, "float32"):
        names = ("relative_gap_max", "relative_gap_p99", "relative_gap_median")
        gaps = (f"{row[name]:.1e}" for name in names)
        rows.append([row["at"], row["by"], row["mode"], *gaps, f"{row['share_below_1e-3']:.4f}"])
    return _with_run(rows, record)


def floor_view(record: dict[str, Any]) -> str:
    """Metrics of the ground truth against itself."""
    rows = [["samples per mesh", *(f"bounding-box IoU, {region}" for region in REGIONS)]]
    for row in record["rows"]:
        rows.append(
            [str(row["samples"]), *(f"{row[f'iou_box_{region}']:.3f}" for region in REGIONS)]
        )
    header = record["header"]
    return f"{_table(rows)}\n\n{_machine(header)}; {header['frames']} held-out frames."


def memory_view(record: dict[str, Any]) -> str:
    """Peak memory of the process, one row per number of frames."""
    stages = (("fit", "after training"), ("all", "after evaluation"))
    rows = [["training frames", "chosen", *(f"{label}, GiB" for _, label in stages)]]
    for row in record["rows"]:
        peaks = [f"{row[f'peak_rss_{name}_mb'] / 1024:.2f}" for name, _ in stages]
        rows.append([f"{row['frames']:,}", str(row["learned_from"]), *peaks])
    header = record["header"]
    return f"{_table(rows)}\n\n{_machine(header)}; preset `quick`, {header['steps']} steps."


_RUN_COLUMNS = (
    ("cd_all_mm", "Chamfer, all, mm", 2),
    ("cd_hands_mm", "hands", 2),
    ("cd_face_mm", "face", 2),
)
_ABLATION_COLUMNS = (
    *_RUN_COLUMNS,
    ("steps", "steps", 0),
    ("step_ms", "ms per step", 0),
    ("search_share", "share of the search", 2),
    ("seeds", "seeds", 0),
)
_METHOD_COLUMNS = (
    *_RUN_COLUMNS,
    ("cd_max_all_mm", "maximum, all, mm", 1),
    ("cd_max_hands_mm", "hands", 1),
    ("nc_all", "normal consistency", 3),
    ("iou_all", "IoU", 3),
    ("steps", "steps", 0),
    ("mesh_ms", "ms per mesh", 0),
    ("seeds", "seeds", 0),
)
_CURVE_COLUMNS = (
    ("minutes", "minutes", 1),
    *_RUN_COLUMNS,
    ("steps", "steps", 0),
    ("seeds", "seeds", 0),
)


def medians_view(
    by: tuple[str, ...], columns: tuple[tuple[str, str, int], ...]
) -> Callable[[dict[str, Any]], str]:
    """Medians over seeds, one row per distinct `by`; entries that are columns are not repeated."""
    shown = [name for name in by if name not in {column for column, _, _ in columns}]

    def view(record: dict[str, Any]) -> str:
        from resumable import medians

        rows = [[*shown, *(label for _, label, _ in columns)]]
        found = medians(record["rows"], by)
        first = list(dict.fromkeys(row[by[0]] for row in found))
        for row in sorted(found, key=lambda row: (first.index(row[by[0]]), row.get("minutes", 0))):
            rows.append([*(f"{row[name]}" for name in shown), *_cells(row, columns)])
        header = record["header"]
        budget = f", {header['minutes']:g} minutes per run" if "minutes" in header else ""
        commits = list(dict.fromkeys(row["commit"][:7] for row in record["rows"]))
        made = f" Commits: {', '.join(commits)}." if len(commits) > 1 else ""
        return (
            f"{_table(rows)}\n\n{_sentence(_machine(header))}; {header['eval_frames']} held-out "
            f"frames{budget}; medians over seeds.{made}"
        )

    return view


def time_of_gradients_view(record: dict[str, Any]) -> str:
    """Milliseconds for roots and their derivatives with respect to the field's parameters."""
    rows = [["method", "mode", "ms per 1000 points", "first call, s"]]
    for row in _of_table(record, "time"):
        rows.append(
            [
                row["method"],
                row["mode"],
                f"{row['ms_per_1000_points']:.0f}",
                f"{row['first_call_s']:.1f}",
            ]
        )
    (step,) = _of_table(record, "step")
    return (
        f"{_with_run(rows, record)} A training step with the search inside compiles in "
        f"{step['compile_s']:.1f} s; traces in two calls: {step['traces']}."
    )


def _of_table(record: dict[str, Any], name: str) -> list[dict[str, Any]]:
    return [row for row in record["rows"] if row["table"] == name]


def _cells(row: dict[str, Any], columns: tuple[tuple[str, str, int], ...]) -> list[str]:
    # A dash: not defined for this path.
    found = [(row.get(name), digits) for name, _, digits in columns]
    return ["–" if value is None else f"{value:.{digits}f}" for value, digits in found]


def _with_run(rows: list[list[str]], record: dict[str, Any]) -> str:
    header = record["header"]
    size = "quick" if header["quick"] else "full"
    if len(rows) == 1:
        return NOT_MEASURED
    grid = ""
    if "grid_mm" in header:
        spacing = {name: header.get(f"{name}_mm") for name in ("grid", "guide")}
        sizes = [
            f"{name} spacing {', '.join(f'{value:g}' for value in mm)} mm"
            for name, mm in spacing.items()
            if mm
        ]
        grid = f", {' and '.join(sizes)} (body, hands, face)"
    return (
        f"{_table(rows)}\n\n{_sentence(_machine(header))}; {size} run, seed {header['seed']}, "
        f"network fitted in {header['prefit_steps']} steps{grid}."
    )


def presets_view() -> str:
    """The two presets side by side."""
    import xavatar_jax as xa

    rows = [["entry", "`quick`", "`paper`"]]
    for entry, label in _ENTRIES:
        values = [attrgetter(entry)(config) for config in (xa.quick(), xa.paper())]
        rows.append([label.format(f"`{entry}`"), *map(str, values)])
    return _table(rows)


VIEWS: dict[str, Callable[[dict[str, Any]], str]] = {
    f"docs/figures/{METRICS}": accuracy_view,
    f"docs/figures/{METRICS} stages": stages_view,
    f"docs/figures/{METRICS} distance": distance_view,
    f"docs/figures/{SEEDS}": seeds_view,
    f"docs/figures/{PAPER}": paper_view,
    f"docs/figures/{PART_AWARE}": benchmark_view,
    f"docs/figures/{ANIMATE}": animate_view,
    f"docs/figures/{ANIMATE} export": export_view,
    f"docs/figures/{ANIMATE} extraction": extraction_view,
    f"docs/figures/{SURFACE}": extraction_view,
    f"docs/figures/{VIEW}": seconds_view,
    f"docs/figures/{SEARCH} 20": paths_view(20.0),
    f"docs/figures/{SEARCH} 40": paths_view(40.0),
    f"docs/figures/{SEARCH} batches": batches_view,
    f"docs/figures/{SEARCH} resolution": resolution_view,
    f"docs/figures/{SEARCH} contact": contact_view,
    f"docs/figures/{BORDERS}": borders_view,
    f"docs/figures/{GRADIENTS} accuracy": accuracy_of_gradients_view,
    f"docs/figures/{GRADIENTS} float32": float32_view,
    f"docs/figures/{GRADIENTS} time": time_of_gradients_view,
    f"docs/figures/{FLOOR}": floor_view,
    f"docs/figures/{MEMORY}": memory_view,
    f"docs/figures/{TABLE1}": medians_view(("setting", "name"), _ABLATION_COLUMNS),
    f"docs/figures/{TABLE2}": medians_view(("name",), _METHOD_COLUMNS),
    f"docs/figures/{CURVE}": medians_view(("name", "minutes"), _CURVE_COLUMNS),
}
_BLOCK = re.compile(r"(<!-- figures: (.+?) -->\n).*?(<!-- end of figures -->)", re.DOTALL)


def filled(text: str) -> str:
    """The text with all tables regenerated.

    **Raises:** `KeyError` for a block without a view.
    """

    def write(match: re.Match[str]) -> str:
        return f"{match[1]}{_body(match[2])}\n{match[3]}"

    return _BLOCK.sub(write, text)


def _body(name: str) -> str:
    if name == "presets":
        return presets_view()
    view, file = VIEWS[name], ROOT / name.split()[0]
    return view(json.loads(file.read_text("utf-8"))) if file.exists() else NOT_MEASURED


def _table(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    rule = "|---|" + "---:|" * (len(rows[0]) - 1)
    return "\n".join([lines[0], rule, *lines[1:]])


def _number(value: float | None, digits: int) -> str:
    return "not measured" if value is None else f"{value:.{digits}f}"


def _machine(record: dict[str, Any]) -> str:
    platform, _, kind = record["device"].partition(": ")
    place = f"{record['cores']} CPU cores" if platform == "cpu" else kind
    versions = record["versions"]
    return f"{place}, Python {versions['python']}, JAX {versions['jax']}"


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:]


def _store(source: str, name: str, slim: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    _write(name, slim(json.loads(Path(source).read_text("utf-8"))))


def _write(name: str, record: dict[str, Any]) -> None:
    text = json.dumps(record, indent=2, allow_nan=False)
    (FOLDER / name).write_text(text + "\n", encoding="utf-8")


_STORED = {
    "metrics": METRICS,
    "metrics_paper": PAPER,
    "part_aware": PART_AWARE,
    "animate": ANIMATE,
    "surface": SURFACE,
    "view": VIEW,
    "correspondence": SEARCH,
    "gradients": GRADIENTS,
    "borders": BORDERS,
    "metric_floor": FLOOR,
    "memory": MEMORY,
    "table1": TABLE1,
    "table2": TABLE2,
    "curve": CURVE,
}
"""File in this folder for each option."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--metrics", help="metrics.json of examples/fit_grab.py")
    parser.add_argument("--metrics-paper", help="metrics.json of a --preset paper --steps 20 run")
    parser.add_argument("--part-aware", help="JSON of benchmarks/part_aware_vs_all_bones.py")
    parser.add_argument("--animate", help="JSON of benchmarks/animate.py")
    parser.add_argument("--surface", help="JSON of benchmarks/animate.py --surface, preset paper")
    parser.add_argument("--view", help="JSON of benchmarks/view_and_render.py")
    parser.add_argument("--correspondence", help="JSON of benchmarks/correspondence.py")
    parser.add_argument("--gradients", help="JSON of benchmarks/gradients.py")
    parser.add_argument("--borders", help="JSON of benchmarks/part_borders.py")
    parser.add_argument("--metric-floor", help="JSON of benchmarks/metric_floor.py")
    parser.add_argument("--memory", help="JSON of benchmarks/memory.py")
    parser.add_argument("--table1", help="JSON of benchmarks/table1_ablations.py")
    parser.add_argument("--table2", help="JSON of benchmarks/table2_grab.py")
    parser.add_argument("--curve", help="JSON of benchmarks/accuracy_over_time.py")
    parser.add_argument("--metrics-seeds", nargs="+", help="several metrics.json, one per seed")
    args = parser.parse_args()
    for option, source in vars(args).items():
        if option == "metrics_seeds" and source:
            runs = [slim_metrics(json.loads(Path(file).read_text("utf-8"))) for file in source]
            _write(SEEDS, {"runs": runs})
        elif source:
            slim = slim_metrics if option.startswith("metrics") else slim_benchmark
            _store(source, _STORED[option], slim)
    for name in TEXTS:
        path = ROOT / name
        path.write_text(filled(path.read_text("utf-8")), encoding="utf-8")
        print(f"written: {name}")


if __name__ == "__main__":
    main()
