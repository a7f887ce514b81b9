"""Keeps the measured figures and puts them into the texts, so that no figure is typed by hand.

    python docs/figures/update.py                                    # write the tables again
    python docs/figures/update.py --metrics out/fit_grab/metrics.json
    python docs/figures/update.py --part-aware part_aware.json
    python docs/figures/update.py --animate animate.json

A result is copied into this folder without what is of no use elsewhere (paths, single frames).
A text has its tables between `<!-- figures: FILE VIEW -->` and `<!-- end of figures -->`; the table
of presets comes from the library itself.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "figures"
TEXTS = ("README.md", "docs/benchmarks.md", "docs/options.md", "docs/animate-and-export.md")
METRICS, PART_AWARE = "metrics.json", "part_aware_vs_all_bones.json"
ANIMATE = "animate.json"
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
    ("points_per_step", "{}, of each frame"),
    ("points.total", "{}, drawn of each frame"),
    ("skinning.kind", "{}"),
    ("geometry.kind", "{}"),
    ("search.starts", "{}"),
    ("search.cached", "{}"),
    ("search.keep", "{}, roots a point"),
    ("losses.softness", "{}, metres"),
    ("losses.bone", "{}"),
    ("losses.joint", "{}"),
    ("losses.surface", "{}"),
    ("losses.surface_parts", "{}"),
    ("optimiser.learning_rate", "{}"),
    ("optimiser.skinning_rate", "{}"),
    ("optimiser.schedule", "{}"),
    ("optimiser.clip", "{}"),
    ("validation.every", "{}, steps"),
    ("validation.patience", "{}, steps"),
    ("prefit_steps", "{}"),
)
_SEARCH = (
    ("search_points_per_s", "search, points/s", 0),
    ("starts_per_point", "starts a point", 1),
    ("steps_per_start", "solver steps a start", 1),
    ("recall_all", "known correspondences found, all", 4),
    ("recall_body", "the same, body", 4),
    ("recall_face", "the same, face", 4),
    ("recall_hands", "the same, hands", 4),
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
    ("processor_ms_per_frame", "processor time a frame, ms", 1),
    ("vertex_mean_mm", "from vertex to vertex, mean, mm", 3),
    ("vertex_p99_mm", "the same, 99th percentile", 2),
    ("surface_mean_mm", "from vertex to surface, mean, mm", 3),
    ("surface_p99_mm", "the same, 99th percentile", 2),
    ("surface_max_mm", "the same, maximum", 1),
)
_EXPORT = (
    ("seconds", "time, s", 1),
    ("megabytes", "size, MB", 1),
    ("influences_mean_mm", "lost by bones left out, mean, mm", 3),
    ("influences_max_mm", "the same, maximum", 2),
    ("rig_mean_mm", "lost in all, mean, mm", 3),
    ("rig_max_mm", "the same, maximum", 1),
)


def slim_metrics(record: dict[str, Any]) -> dict[str, Any]:
    """What is kept of a run's `metrics.json`."""
    return {name: record[name] for name in _KEPT if name in record}


def slim_benchmark(record: dict[str, Any]) -> dict[str, Any]:
    """What is kept of a benchmark's JSON."""
    header = {name: value for name, value in record["header"].items() if name != "platform"}
    return {"header": header, "rows": record["rows"]}


def accuracy_view(record: dict[str, Any]) -> str:
    """Held-out figures after and before training, and what they were measured on."""
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
        f"{_machine(record)}: {record['seconds']['total']:.0f} s in all, "
        f"{record['peak_rss_mb'] / 1024:.1f} GiB of memory at most. "
        f"*Before* is the start, the body's mean shape on the person's skeleton, "
        f"on {few} of the frames."
    )


def stages_view(record: dict[str, Any]) -> str:
    """Seconds by stage."""
    rows = [["stage", "seconds"]]
    rows += [[name, f"{value:.0f}"] for name, value in record["seconds"].items()]
    return f"{_table(rows)}\n\n{_sentence(_machine(record))}."


def distance_view(record: dict[str, Any]) -> str:
    """Held-out figures by how far a pose is from those learned from."""
    if "by_pose_distance" not in record:
        return NOT_MEASURED
    rows = [["", "degrees", "frames", *(f"Chamfer, {region}, mm" for region in REGIONS)]]
    for name, group in record["by_pose_distance"].items():
        low, high = group["pose_distance_deg"]
        figures = [_number(group["cd_mm"][region], 2) for region in REGIONS]
        rows.append([name, f"{low:.1f} to {high:.1f}", str(group["frames"]), *figures])
    return f"{_table(rows)}\n\n{_sentence(_machine(record))}."


def benchmark_view(record: dict[str, Any]) -> str:
    """One column a start set."""
    columns = record["rows"]
    rows = [["", *(column["starts"] for column in columns)]]
    for name, label, digits in _SEARCH:
        rows.append([label, *(_number(column[name], digits) for column in columns)])
    header = record["header"]
    size = "quick" if header["quick"] else "full"
    return (
        f"{_table(rows)}\n\n{_sentence(_machine(header))}; {size} run, seed {header['seed']}, "
        f"{header['points_per_step']} points a training step; equal time is "
        f"{header['equal_time_s']:.0f} s of training."
    )


def animate_view(record: dict[str, Any]) -> str:
    """One column a way of following pose and expression."""
    columns, header = record["rows"], record["header"]
    rows = [["`offsets`", *(f"`{column['offsets']}`" for column in columns)]]
    for name, label, digits in _ANIMATE:
        values = (_number(column.get(name), digits) for column in columns)
        rows.append([label, *(value if value != "not measured" else "-" for value in values)])
    return (
        f"{_table(rows)}\n\n{_sentence(_machine(header))}; preset `{header['preset']}`, "
        f"{header['vertices']} vertices, {header['frames']} frames; extraction of the neutral "
        f"surface {header['extraction_s']:.1f} s and what is kept of it {header['base_s']:.1f} s, "
        f"once an avatar."
    )


def export_view(record: dict[str, Any]) -> str:
    """One column a number of influences."""
    exports, header = record["header"]["exports"], record["header"]
    rows = [["influences a vertex", *(str(export["influences"]) for export in exports)]]
    for name, label, digits in _EXPORT:
        rows.append([label, *(_number(export[name], digits) for export in exports)])
    return f"{_table(rows)}\n\n{_sentence(_machine(header))}; {header['frames']} frames."


def presets_view() -> str:
    """Entries of the two presets, side by side."""
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
    f"docs/figures/{PART_AWARE}": benchmark_view,
    f"docs/figures/{ANIMATE}": animate_view,
    f"docs/figures/{ANIMATE} export": export_view,
}
_BLOCK = re.compile(r"(<!-- figures: (.+?) -->\n).*?(<!-- end of figures -->)", re.DOTALL)


def filled(text: str) -> str:
    """The text with every table written anew.

    **Raises:** `KeyError` for a block that no view knows.
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
    record = slim(json.loads(Path(source).read_text("utf-8")))
    text = json.dumps(record, indent=2, allow_nan=False)
    (FOLDER / name).write_text(text + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--metrics", help="metrics.json of examples/fit_grab.py")
    parser.add_argument("--part-aware", help="JSON of benchmarks/part_aware_vs_all_bones.py")
    parser.add_argument("--animate", help="JSON of benchmarks/animate.py")
    args = parser.parse_args()
    if args.metrics:
        _store(args.metrics, METRICS, slim_metrics)
    if args.part_aware:
        _store(args.part_aware, PART_AWARE, slim_benchmark)
    if args.animate:
        _store(args.animate, ANIMATE, slim_benchmark)
    for name in TEXTS:
        path = ROOT / name
        path.write_text(filled(path.read_text("utf-8")), encoding="utf-8")
        print(f"written: {name}")


if __name__ == "__main__":
    main()
