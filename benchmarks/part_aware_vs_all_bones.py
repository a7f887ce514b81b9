"""Part-aware against all-bone and body-only starts: cost, recall and accuracy.

Question: what do part-aware starts (X-Avatar, section 3.3) save, and what do they lose, against
starting every point's search from all 45 bones, or from the 9 of the body?

Same frames, same fields, same points for the three. The skinning field is the paper's network
(5 x 128), fitted to the body's mean shape; roots are searched inside the training step, so that
the search's share of a step is the method's own.

    python benchmarks/part_aware_vs_all_bones.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import xavatar_jax as xa
from xavatar_jax.avatar import Avatar
from xavatar_jax.body import BODY, FACES, HANDS, canonical_vertices
from xavatar_jax.correspondence import StartSet, search_field, start_table
from xavatar_jax.kinematics import skin_points
from xavatar_jax.report import describe_machine, write_json
from xavatar_jax.sampling import varied_frames
from xavatar_jax.training import AvatarFields, FitConfig, paper, subject_betas
from xavatar_jax.training.loop import train_pool
from xavatar_jax.training.pool import FramePool, label_frames
from xavatar_jax.training.prefit import initial_fields
from xavatar_jax.training.progress import progress

STARTS: tuple[StartSet, ...] = ("paper", "full", "body")
NAMES = {"paper": "part-aware", "full": "all bones (A2)", "body": "body bones (A1)"}


def benchmark_config(quick: bool, seed: int) -> FitConfig:
    """The paper's skinning network and losses; a geometry field and counts for two cores."""
    config = paper()
    return replace(
        config,
        seed=seed,
        steps=40 if quick else 200,
        train_frames=6 if quick else 30,
        frames_per_step=2,
        points_per_step=400 if quick else 1000,
        prefit_steps=1000 if quick else 4000,
        geometry=replace(xa.quick().geometry),
        search=replace(config.search, keep=3),
        losses=replace(config.losses, softness=0.004, surface_points=512),
        optimiser=replace(config.optimiser, learning_rate=3e-3, skinning_rate=1e-4, clip=1.0),
    )


def known_points(
    avatar: Avatar, frames: xa.Frames, count: int, seed: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, jax.Array]]:
    """Canonical points near the surface and where the field itself carries them in each frame."""
    rng = np.random.default_rng(seed)
    body = avatar.body
    labels = np.asarray(body.part_labels)
    canonical = np.asarray(canonical_vertices(body, jnp.asarray(avatar.betas)))
    shares = (((BODY,), 0.5), (FACES, 1 / 6), (HANDS, 1 / 3))
    pose = eqx.filter_jit(lambda field, x, b: jax.vmap(lambda p: skin_points(p, field(p), b))(x))
    cases = []
    for frame in frames:
        rows = np.concatenate(
            [
                rng.choice(np.flatnonzero(np.isin(labels, parts)), int(count * share))
                for parts, share in shares
            ]
        )
        x_c = canonical[rows] + 0.005 * rng.standard_normal((len(rows), 3))
        transforms = xa.bone_transforms(body, frame.params)
        x_d = pose(avatar.fields.skinning, jnp.asarray(x_c, jnp.float32), transforms)
        cases.append((x_c, labels[rows].astype(np.int32), np.asarray(x_d), transforms))
    return cases


def measure_search(avatar: Avatar, cases: list, starts: StartSet) -> dict[str, Any]:
    """Points a second and recall of the generating correspondence, on the network itself."""
    table = start_table(avatar.body.tree, starts)
    field = avatar.fields.skinning
    first = cases[0]
    clock = time.perf_counter()
    jax.block_until_ready(search_field(field, first[2], first[1], first[3], table))
    compile_s = time.perf_counter() - clock
    spent, steps, lanes, hit, part = 0.0, 0, 0, [], []
    for x_c, labels, x_d, transforms in cases:
        clock = time.perf_counter()
        roots = jax.block_until_ready(search_field(field, x_d, labels, transforms, table))
        spent += time.perf_counter() - clock
        steps, lanes = steps + int(roots.steps), lanes + int(roots.lanes)
        gap = np.linalg.norm(np.asarray(roots.x_c) - x_c[:, None], axis=-1)
        hit.append(np.where(np.asarray(roots.valid), gap, np.inf).min(1) < 1e-3)
        part.append(labels)
    hits, parts = np.concatenate(hit), np.concatenate(part)
    return {
        "search_points_per_s": len(hits) / spent,
        "first_call_s": compile_s,
        "starts_per_point": lanes / len(hits),
        "steps_per_start": steps / lanes,
        "recall_all": float(hits.mean()),
        "recall_body": float(hits[parts == BODY].mean()),
        "recall_face": float(hits[np.isin(parts, FACES)].mean()),
        "recall_hands": float(hits[np.isin(parts, HANDS)].mean()),
    }


def train(
    start: AvatarFields,
    pool: FramePool,
    capture: Any,
    betas: np.ndarray,
    config: FitConfig,
    starts: StartSet,
) -> tuple[dict[str, Any], list[tuple[float, int, AvatarFields]]]:
    """Steps a second, and the fields as they were along the way, with seconds and steps."""
    config = replace(config, search=replace(config.search, starts=starts), report_every=5)
    way: list[tuple[float, int, AvatarFields]] = []
    clock = [time.perf_counter()]

    def keep(step: int, fields: AvatarFields, terms: dict[str, float]) -> None:
        now = time.perf_counter()
        way.append((now - clock[0], step, fields))

    done = train_pool(
        capture.body,
        start,
        pool,
        betas,
        config,
        verbose=False,
        callback=keep,
    ).history
    # Compilation ended before the first step that counts.
    way = [(elapsed - done.seconds["compile"], step, fields) for elapsed, step, fields in way]
    row = {
        "steps": done.steps_done,
        "train_steps_per_s": (done.steps_done - 1) / done.seconds["train"],
        "step_compile_s": done.seconds["compile"],
        "root_found": done.terms["found"][-1],
    }
    return row, way


def score(fields: AvatarFields, capture: Any, betas: np.ndarray, config: FitConfig, frames: int):
    """Held-out Chamfer distances in mm, by region."""
    avatar = Avatar(capture.body, betas, fields, config)
    result = xa.evaluate(avatar, capture.test, num_frames=frames, verbose=False).mean.cd_mm
    return result.to_json()


def main() -> None:
    parser = argparse.ArgumentParser(description="Part-aware against all-bone starts.")
    parser.add_argument("--quick", action="store_true", help="small: ends within five minutes")
    parser.add_argument("--json", help="write header and rows to this file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache-dir")
    args = parser.parse_args()
    config = benchmark_config(args.quick, args.seed)
    body = xa.synthetic_body(args.cache_dir)
    capture = xa.synthetic_capture(args.cache_dir, body=body)
    betas = subject_betas(capture.train)
    start = initial_fields(body, config, cache=args.cache_dir)
    chosen = capture.train[varied_frames(capture.train.params, config.train_frames)]
    with progress("points", len(chosen), verbose=True, unit="frame") as bar:
        pool = label_frames(body, chosen, config, bar=bar)
    avatar = Avatar(body, betas, start, config)
    cases = known_points(avatar, chosen[: 2 if args.quick else 6], 1200, args.seed)
    eval_frames = 2 if args.quick else 6
    rows: list[dict[str, Any]] = []
    budget = 0.0
    for starts in STARTS:
        row: dict[str, Any] = {"starts": NAMES[starts], **measure_search(avatar, cases, starts)}
        trained, way = train(start, pool, capture, betas, config, starts)
        # Equal time: what the part-aware run, which comes first, took for its steps.
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
    if args.json:
        write_json(args.json, {"header": header, "rows": rows})
        print(f"written: {args.json}")


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
