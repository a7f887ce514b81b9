"""Checks what `examples/fit_grab.py` promises to leave behind: files, keys, finite numbers.

python .ci/check_run.py FOLDER
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

REGIONS = ("all", "hands", "face")
FIGURES = ("cd_mm", "cd_max_mm", "nc", "iou", "iou_near", "iou_box", "count")
SECONDS = ("data", "compile", "train", "evaluate", "total")
OTHERS = ("preset", "seed", "commit", "device", "versions", "peak_rss_mb")
FILES = ("avatar.npz", "metrics.json", "preview.png", "animation.webp")


def faults(folder: Path) -> list[str]:
    """What is missing or wrong, in words; empty if nothing is."""
    found = [f"no file {name}" for name in FILES if not (folder / name).is_file()]
    for kind in ("avatar", "truth"):
        if not list(folder.glob(f"*_{kind}.ply")):
            found.append(f"no *_{kind}.ply")
    if "no file metrics.json" in found:
        return found
    record = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    found += _figures(record, "")
    found += _figures(record.get("before"), "before.")
    for k, frame in enumerate(record.get("per_frame", [])):
        found += _figures(frame, f"per_frame[{k}].")
    if not record.get("frames") or len(record.get("per_frame", [])) != record["frames"]:
        found.append("frames is not the length of per_frame")
    seconds = record.get("seconds", {})
    found += [f"seconds.{name} is not a number" for name in SECONDS if not _finite(seconds, name)]
    found += [f"no {name}" for name in OTHERS if name not in record]
    if not found:
        after, before = record["cd_mm"], record["before"]["cd_mm"]
        worse = [region for region in REGIONS if after[region] >= before[region]]
        found += [f"cd_mm.{region} is no better than before" for region in worse]
    return found


def _figures(record: Any, where: str) -> list[str]:
    if not isinstance(record, dict):
        return [f"no {where}figures"]
    return [
        f"{where}{name}.{region} is not a finite number"
        for name in FIGURES
        for region in REGIONS
        if not _finite(record.get(name, {}), region)
    ]


def _finite(record: Any, name: str) -> bool:
    value = record.get(name)
    return isinstance(value, int | float) and math.isfinite(value)


def main() -> None:
    found = faults(Path(sys.argv[1]))
    if found:
        sys.exit("\n".join(found))
    print(f"{sys.argv[1]}: all files, keys and numbers are there")


if __name__ == "__main__":
    main()
