"""Part-aware, all-bone and body-only starts: cost, recall and accuracy.

Question: how much time do part-aware starts (X-Avatar, section 3.3) save, and how many roots do
they lose, compared with starting from all 45 bones or from the 9 body bones?

All start sets use the same frames, fields and points. The skinning field is the paper's network
(5 x 128), fitted to the body's mean shape. Roots are searched inside the training step, as in the
paper, so the search takes its full share of a step.

    python benchmarks/part_aware_vs_all_bones.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from measuring import least_time, write_result
from search_problems import (
    FULL_PREFIT,
    QUICK_PREFIT,
    Problem,
    hits,
    known_points,
    labelled_frames,
    mean_shape_model,
    paper_config,
    recall,
    stages_of,
)

import xavatar_jax as xa
from xavatar_jax.avatar import Avatar
from xavatar_jax.body import canonical_vertices
from xavatar_jax.correspondence import Roots, StartSet, search_field, start_table
from xavatar_jax.fields import AvatarModel
from xavatar_jax.learning import Schedule, train
from xavatar_jax.methods.observations import subject_betas
from xavatar_jax.methods.xavatar import FitConfig
from xavatar_jax.methods.xavatar.roots import FrameData
from xavatar_jax.report import describe_machine
from xavatar_jax.sampling import varied_frames

STARTS: tuple[StartSet, ...] = ("paper", "all_bones", "body")
NAMES = {"paper": "part-aware", "all_bones": "all bones (A2)", "body": "body bones (A1)"}


def benchmark_config(quick: bool, seed: int) -> FitConfig:
    """The paper's skinning network and losses, with a geometry field and counts for two cores."""
    config = paper_config(seed, QUICK_PREFIT if quick else FULL_PREFIT)
    return replace(
        config,
        steps=40 if quick else 200,
        train_frames=6 if quick else 30,
        frames_per_step=2,
        points_per_step=400 if quick else 1000,
        search=replace(config.search, keep=3),
        # The geometry is on grids, which need no warm-up.
        optimiser=replace(config.optimiser, warmup=0),
    )


def capture_problems(avatar: Avatar, frames: xa.Frames, count: int, seed: int) -> list[Problem]:
    """Points near the person's canonical surface, posed by the field in each frame."""
    vertices = np.asarray(canonical_vertices(avatar.body, jnp.asarray(avatar.betas)))
    poses = [frame.params for frame in frames]
    return known_points(avatar.body, avatar.model.skinning, vertices, poses, count, seed)


def measure_search(avatar: Avatar, problems: list[Problem], starts: StartSet) -> dict[str, Any]:
    """Points per second and recall of known correspondences, on the network."""
    table = start_table(avatar.body, starts)
    field = avatar.model.skinning

    def search(p: Problem) -> Roots:
        return search_field(field, p.x_d, p.parts, p.transforms, table)

    _, compile_s = least_time(lambda: search(problems[0]), 1)
    spent, steps, lanes, hit, part = 0.0, 0, 0, [], []
    for problem in problems:
        roots, seconds = least_time(lambda p=problem: search(p), 1)
        spent += seconds
        steps, lanes = steps + int(roots.steps), lanes + int(roots.lanes)
        hit.append(hits(np.asarray(roots.x_c), np.asarray(roots.valid), np.asarray(problem.x_c)))
        part.append(np.asarray(problem.parts))
    found, parts = np.concatenate(hit), np.concatenate(part)
    return {
        "search_points_per_s": len(found) / spent,
        "first_call_s": compile_s,
        "starts_per_point": lanes / len(found),
        "steps_per_start": steps / lanes,
        **recall(found, parts),
    }


def learn(
    start: AvatarModel,
    data: FrameData,
    capture: Any,
    betas: np.ndarray,
    config: FitConfig,
    starts: StartSet,
) -> tuple[dict[str, Any], list[tuple[float, int, AvatarModel]]]:
    """Steps per second, and snapshots of the model with their seconds and steps."""
    config = replace(config, search=replace(config.search, starts=starts))
    way: list[tuple[float, int, AvatarModel]] = []
    clock = [time.perf_counter()]

    def keep(step: int, model: AvatarModel, terms: dict[str, float]) -> None:
        now = time.perf_counter()
        way.append((now - clock[0], step, model))

    stages = stages_of(capture.body, betas, data, config)
    schedule = Schedule(config.steps, seed=config.seed, report_every=5)
    done = train(start, data, stages, schedule, verbose=False, callback=keep).history
    # Exclude compilation.
    way = [(elapsed - done.seconds["compile"], step, model) for elapsed, step, model in way]
    row = {
        "steps": done.steps_done,
        "train_steps_per_s": (done.steps_done - 1) / done.seconds["train"],
        "step_compile_s": done.seconds["compile"],
        "root_found": done.terms["found"][-1],
    }
    return row, way


def score(model: AvatarModel, capture: Any, betas: np.ndarray, config: FitConfig, frames: int):
    """Held-out Chamfer distances in mm, by region."""
    avatar = Avatar(capture.body, betas, model, config.spec)
    result = xa.evaluate(avatar, capture.test, num_frames=frames, verbose=False).mean.cd_mm
    return result.to_json()


def main() -> None:
    parser = argparse.ArgumentParser(description="Part-aware and all-bone starts.")
    parser.add_argument("--quick", action="store_true", help="small run of less than five minutes")
    parser.add_argument("--json", help="JSON file for header and rows")
    parser.add_argument("--steps", type=int, help="number of training steps per run")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache-dir")
    args = parser.parse_args()
    config = benchmark_config(args.quick, args.seed)
    config = replace(config, steps=args.steps or config.steps)
    body = xa.synthetic_body(args.cache_dir)
    capture = xa.synthetic_capture(args.cache_dir, body=body)
    betas = subject_betas(capture.train)
    start = mean_shape_model(body, config, cache=args.cache_dir)
    chosen = capture.train[varied_frames(capture.train.params, config.train_frames)]
    data = labelled_frames(body, chosen, config)
    avatar = Avatar(body, betas, start, config.spec)
    problems = capture_problems(avatar, chosen[: 2 if args.quick else 6], 1200, args.seed)
    eval_frames = 2 if args.quick else 6
    rows: list[dict[str, Any]] = []
    budget = 0.0
    for starts in STARTS:
        row: dict[str, Any] = {"starts": NAMES[starts], **measure_search(avatar, problems, starts)}
        trained, way = learn(start, data, capture, betas, config, starts)
        # Equal time: the time of the part-aware run, which comes first.
        budget = budget or way[-1][0]
        in_time = [entry for entry in way if entry[0] <= budget] or way[:1]
        row |= trained
        for region, value in score(way[-1][2], capture, betas, config, eval_frames).items():
            row[f"cd_{region}_mm"] = value
        row["equal_time_steps"] = in_time[-1][1]
        timed = score(in_time[-1][2], capture, betas, config, eval_frames)
        for region, value in timed.items():
            row[f"equal_time_cd_{region}_mm"] = value
        rows.append(row)
        print(f"{row['starts']}: {row['train_steps_per_s']:.2f} training steps/s", flush=True)
    header = {
        "question": "part-aware against all-bone and body-only starts",
        **describe_machine(),
        "quick": args.quick,
        "seed": args.seed,
        "points_per_step": config.frames_per_step * config.points_per_step,
        "equal_time_s": budget,
    }
    print_table(header, rows)
    write_result(args.json, header, rows)


def print_table(header: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    print(f"{header['device']}, {header['cores']} cores, commit {header['commit']}")
    print(f"{'':28}" + "".join(f"{row['starts']:>18}" for row in rows))
    for name in rows[0]:
        if name != "starts":
            print(f"{name:28}" + "".join(f"{_cell(row[name]):>18}" for row in rows))
    first = rows[0]
    for row in rows[1:]:
        print(
            f"part-aware against {row['starts']}: "
            f"{first['search_points_per_s'] / row['search_points_per_s']:.2f} x search, "
            f"{first['train_steps_per_s'] / row['train_steps_per_s']:.2f} x training steps/s, "
            f"hands {_cell(first['cd_hands_mm'])} mm against {_cell(row['cd_hands_mm'])} mm"
        )


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    main()
