"""The paper's ablations at equal time.

Question: how much held-out accuracy is lost, especially on the hands, if every search starts from
the body bones (A1) or from all bones (A2), if points are sampled without regard to parts (A3), or
if there is no loss on the skinning weights at the surface (A4)? And if the template's weights are
kept fixed?

Each row is a run of `xa.fit` with a time limit, on the bundled capture. Settings:

- `quick`: the preset, with roots that are found once and polished.
- `mlp`: the paper's skinning network, fitted to the mean shape's weights first; roots are searched
  in every step, with a guide, on fewer points.
- `mlp-random`: as `mlp`, with random initial weights.

    python benchmarks/table1_ablations.py --json table1.json [--settings NAME...] [--only NAME...]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import equinox as eqx
import jax
from measuring import least_time
from resumable import Row, add_options, every, fill, medians, read_options, score
from search_problems import labelled_frames, mean_shape_model, stages_of

import xavatar_jax as xa
from xavatar_jax.fields import grids_for_search
from xavatar_jax.methods.xavatar import FitConfig
from xavatar_jax.methods.xavatar.config import ABLATIONS
from xavatar_jax.methods.xavatar.upkeep import GuideRenewal

NAMES = ("complete", *ABLATIONS, "fixed")
SETTINGS = ("quick", "mlp", "mlp-random")
COLUMNS = (
    *("cd_all_mm", "cd_hands_mm", "cd_face_mm", "steps", "step_ms", "search_share", "fit_s"),
    "frames",
)


def setting_config(setting: str, minutes: float) -> FitConfig:
    """Config of the complete method in a setting."""
    config = replace(xa.quick(), minutes=minutes, steps=20_000)
    if setting == "quick":
        return config
    start: Literal["template", "random"] = "random" if setting.endswith("random") else "template"
    return replace(
        config,
        frames_per_step=2,
        points_per_step=500,
        frames_per_minute=30,
        prefit_steps=4000 if start == "template" else config.prefit_steps,
        weights_steps=4000,
        skinning=replace(config.skinning, kind="mlp", start=start),
        search=replace(config.search, cached=False, guide_every=50),
        losses=replace(config.losses, surface_points=512),
        optimiser=replace(config.optimiser, skinning_rate=1e-3),
        validation=replace(config.validation, share=0.0),
    )


def small(config: FitConfig) -> FitConfig:
    """A test run of about a minute."""
    return replace(config, minutes=None, steps=6, train_frames=3, prefit_steps=60, weights_steps=20)


def change(config: FitConfig, name: str) -> FitConfig:
    """Config of one ablation."""
    if name == "fixed":
        return replace(config, learn_skinning=False)
    return ABLATIONS[name](config) if name in ABLATIONS else config


def search_seconds(result: Any, capture: Any, config: FitConfig) -> float:
    """Seconds to draw one step's points and search their roots, on the learned fields."""
    avatar, body = result.avatar, capture.body
    data = labelled_frames(body, result.frames[: config.frames_per_step], config)
    if config.search.guide_every:
        grids = grids_for_search(avatar.model.skinning, body, avatar.betas, config.search.grid)
        data = GuideRenewal(grids, 1)(avatar.model, data, 0)
    (stage,) = stages_of(body, avatar.betas, data, config)
    draw, key = eqx.filter_jit(stage.draw), jax.random.key(config.seed)
    least_time(lambda: draw(avatar.model, data, key), 1)
    return least_time(lambda: draw(avatar.model, data, key), 3)[1]


def measure(
    name: str, setting: str, seed: int, *, capture: Any, args: argparse.Namespace
) -> dict[str, Any]:
    """Metrics of one run."""
    config = setting_config(setting, args.minutes)
    config = change(small(config) if args.quick else config, name)
    config = replace(config, seed=seed)
    # All runs share the first fields, so they are cached before the clock starts.
    mean_shape_model(capture.body, config, cache=args.cache_dir)
    result = xa.fit(capture.train, config, cache=args.cache_dir, verbose=False)
    history, avatar = result.history, result.avatar
    seconds = history.seconds
    step_s = seconds["train"] / max(history.steps_done - 1, 1)
    if config.search.cached:
        share = seconds["roots"] / (seconds["roots"] + seconds["train"])
    else:
        share = search_seconds(result, capture, config) / step_s
    return {
        **score(avatar, capture.test, args.eval_frames),
        "steps": history.steps_done,
        "best_step": history.best_step,
        "frames": history.frames,
        "step_ms": 1000 * step_s,
        "search_share": share,
        "fit_s": seconds["total"],
        "labels_s": seconds["labels"],
        "roots_s": seconds.get("roots"),
        "compile_s": seconds["compile"],
        "stopped": history.stopped,
    }


def compare(rows: Sequence[Row]) -> list[str]:
    """Ablations relative to the complete method, one line each; medians over seeds."""
    said = []
    found = medians(rows, ("setting", "name"))
    for setting in SETTINGS:
        own = {row["name"]: row for row in found if row["setting"] == setting}
        whole = own.pop("complete", None)
        if whole is None:
            continue
        for name, row in own.items():
            words = [f"{setting}, {name} relative to complete:"]
            for region in ("all", "hands", "face"):
                key = f"cd_{region}_mm"
                if whole.get(key) and row.get(key):
                    words.append(f"{region} {100 * (row[key] / whole[key] - 1):+.0f} %,")
            words.append(f"step time x {row['step_ms'] / whole['step_ms']:.2f}")
            said.append(" ".join(words))
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description="The paper's ablations at equal time.")
    add_options(parser, NAMES, minutes=3)
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, metavar="NAME", help="of "
                        + ", ".join(SETTINGS))  # fmt: skip
    args = read_options(parser)
    names = args.only or (("complete", "A3") if args.quick else NAMES)
    settings = args.settings or (("quick",) if args.quick else SETTINGS)
    capture = xa.synthetic_capture(args.cache_dir)
    jobs = every(seed=range(args.seeds), setting=settings, name=names)
    # Random initial weights cannot be kept fixed.
    jobs = [j for j in jobs if j["name"] != "fixed" or not j["setting"].endswith("random")]
    _, rows = fill(
        jobs,
        lambda **job: measure(**job, capture=capture, args=args),
        question="the paper's ablations at equal time",
        settings={
            "quick": args.quick,
            "minutes": args.minutes,
            "eval_frames": args.eval_frames,
            "data": capture.name,
        },
        file=args.json,
        by=("setting", "name"),
        columns=COLUMNS,
    )
    print("\n".join(compare(rows)))


if __name__ == "__main__":
    main()
