"""What each part of the method is worth: the paper's ablations at equal time.

Question: how far does the held-out accuracy fall, of hands above all, if every search starts at
the body's bones (A1) or at all bones (A2), if points are drawn without regard to parts (A3), or
if nothing holds the weights at the surface (A4)? And if the template's weights are kept as they
are?

Every row is a run of `xa.fit` of so many minutes from its call, on the bundled capture. Settings:

- `quick`: the preset, with roots that are found once and polished.
- `mlp`: the paper's skinning network, fitted to the mean shape's weights first; roots are searched
  in every step, with a guide, on fewer points.
- `mlp-random`: the same with the network as it was drawn.

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

import xavatar_jax as xa
from xavatar_jax.training import ABLATIONS, FitConfig, initial_fields
from xavatar_jax.training.config import has_guide
from xavatar_jax.training.objective import search_batch
from xavatar_jax.training.pool import label_frames, tabulate_for_search
from xavatar_jax.training.progress import progress
from xavatar_jax.training.step import draw_batch

NAMES = ("complete", *ABLATIONS, "fixed")
SETTINGS = ("quick", "mlp", "mlp-random")
COLUMNS = (
    *("cd_all_mm", "cd_hands_mm", "cd_face_mm", "steps", "step_ms", "search_share", "fit_s"),
    "frames",
)


def setting_config(setting: str, minutes: float) -> FitConfig:
    """The complete method in a setting."""
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
        settle_steps=4000,
        skinning=replace(config.skinning, kind="mlp", start=start),
        search=replace(config.search, cached=False, guide_every=50),
        losses=replace(config.losses, surface_points=512),
        optimiser=replace(config.optimiser, skinning_rate=1e-3),
        validation=replace(config.validation, share=0.0),
    )


def small(config: FitConfig) -> FitConfig:
    """The same in a minute or so, to see that it runs."""
    return replace(config, minutes=None, steps=6, train_frames=3, prefit_steps=60, settle_steps=20)


def change(config: FitConfig, name: str) -> FitConfig:
    """The config with one thing changed."""
    if name == "fixed":
        return replace(config, skinning=replace(config.skinning, learned=False))
    return ABLATIONS[name](config) if name in ABLATIONS else config


def search_seconds(result: Any, capture: Any, config: FitConfig) -> float:
    """Seconds that the search of one step takes, on the fields that were learned."""
    avatar = result.avatar
    frames = result.frames[: config.frames_per_step]
    with progress("points", len(frames), verbose=False) as bar:
        pool = label_frames(capture.body, frames, config, bar=bar)
    config = replace(config, points_per_step=min(config.points_per_step, pool.points.shape[1]))
    batch = draw_batch(pool, config, config.points_per_step, 0, jax.random.key(config.seed))
    skinning, guide = avatar.fields.skinning, None
    if has_guide(config):
        guide = tabulate_for_search(capture.body, avatar.betas, skinning, config)
    search = eqx.filter_jit(lambda s, g, b: search_batch(s, g, b, config, capture.body.tree))
    least_time(lambda: search(skinning, guide, batch), 1)
    return least_time(lambda: search(skinning, guide, batch), 3)[1]


def measure(
    name: str, setting: str, seed: int, *, capture: Any, args: argparse.Namespace
) -> dict[str, Any]:
    """Figures of one run."""
    config = setting_config(setting, args.minutes)
    config = change(small(config) if args.quick else config, name)
    config = replace(config, seed=seed)
    # The first fields are the same for all, and are not what is compared: they are made before.
    initial_fields(capture.body, config, cache=args.cache_dir)
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
    """A sentence on each ablation beside the complete method, by setting; medians over seeds."""
    said = []
    found = medians(rows, ("setting", "name"))
    for setting in SETTINGS:
        own = {row["name"]: row for row in found if row["setting"] == setting}
        whole = own.pop("complete", None)
        if whole is None:
            continue
        for name, row in own.items():
            words = [f"{setting}, {name} beside complete:"]
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
    # Weights that started at random have nothing to be kept at.
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
