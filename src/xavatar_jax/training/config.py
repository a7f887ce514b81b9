"""What a run is made of, as plain frozen dataclasses; presets are values of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, Literal, get_type_hints

from ..correspondence import StartSet
from ..fields import PAPER_SKINNING, GridSpacing, MLPShape
from ..sampling import SamplingPlan


@dataclass(frozen=True)
class SkinningConfig:
    """`grid`: template weights on part grids with a learned correction; `mlp`: the paper's.

    `start`: from the template's weights, or at random. At random a network is as it was drawn,
    and grids have no template beneath the correction, whose spacing is then that of the field;
    roots have to be searched in the step (`SearchConfig.cached=False`).
    """

    kind: Literal["grid", "mlp"] = "grid"
    start: Literal["template", "random"] = "template"
    grid: GridSpacing = GridSpacing(face=0.0054)
    correction: GridSpacing = GridSpacing(body=0.048, hands=0.012, face=0.024)
    mlp: MLPShape = PAPER_SKINNING
    learned: bool = True


@dataclass(frozen=True)
class GeometryConfig:
    """`hash`: feature grids and a small MLP; `mlp`: the paper's network.

    `spacing` is the node distance of each level in metres; levels finer than `trunk` are read
    at hands (down to `hands`) and face (down to `face`) only. Expression acts at the face, by
    `expression_features` on a grid of `expression_spacing`; nodes `expression_moves` apart know
    how the body model's own expression moves the face, and the field follows (0: it does not).
    """

    kind: Literal["hash", "mlp"] = "hash"
    spacing: tuple[float, ...] = (0.12, 0.07, 0.042, 0.025, 0.015, 0.009, 0.0055, 0.0034)
    trunk: float = 0.009
    hands: float = 0.0034
    face: float = 0.0034
    features: int = 2
    log2_size: int = 17
    width: int = 64
    condition: int = 16
    expression_spacing: float = 0.012
    expression_features: int = 4
    expression_moves: float = 0.008
    sharpness: float = 10.0
    box_margin: float = 0.25
    mlp: MLPShape = MLPShape()


@dataclass(frozen=True)
class SearchConfig:
    """Where roots come from.

    - `starts`: which bones start a point's search.
    - `cached`: search once on the tabulated field when points are drawn, and polish the
      roots by Newton steps now and then; else search inside every training step.
    - `guide_every`: a search inside the step runs on a table of the field first, which is made
      anew every so many steps; its roots are moved to the field's own (0: on the field at once).
    - `grid`: the grids of the tabulated search; `keep`: roots kept a point; `atol`: metres.
    """

    starts: StartSet = "part_aware"
    cached: bool = True
    guide_every: int = 0
    grid: GridSpacing = GridSpacing()
    keep: int = 3
    atol: float = 1e-5
    max_steps: int = 15


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms, and the width of the occupancy step in metres (0: hard labels).

    `surface_parts` says which canonical vertices of the body hold the skinning to the template's:
    those of hands and face, as the released code does, or all. `surface_points` is how many are
    drawn a step (0: all of them).
    """

    softness: float = 0.004
    bone: float = 1.0
    joint: float = 10.0
    surface: float = 10.0
    surface_parts: Literal["hands_face", "all"] = "hands_face"
    surface_points: int = 0


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam with a global-norm clip; `cosine` falls to a hundredth of the rate at the last step.

    - `learning_rate`: of the geometry field, and of either field in the fits before training;
      `skinning_rate`: of the skinning field in training.
    - `warmup`: steps over which the rates rise to what they are.
    """

    learning_rate: float = 1e-3
    skinning_rate: float = 1e-3
    schedule: Literal["constant", "cosine"] = "constant"
    clip: float = 0.1
    epsilon: float = 1e-8
    warmup: int = 0


@dataclass(frozen=True)
class ValidationConfig:
    """Frames that training does not learn from: they decide when it stops and what is kept.

    - `share`: of each training sequence, from its end; sequences shorter than `1 / share` give
      none. 0: no validation, and the last fields are kept.
    - `frames`: how many of these are asked, spread over the sequences; `points`: of each.
    - `every`: steps between two validations.
    - `patience`: steps without a gain after which training ends (0: never). With a cosine
      schedule they count from half of the steps, and the rates then fall to their end within as
      many steps more. `gain`: what counts as one, as a share of the loss.
    """

    share: float = 0.1
    frames: int = 12
    points: int = 512
    every: int = 50
    patience: int = 300
    gain: float = 0.005


@dataclass(frozen=True)
class FitConfig:
    """Everything that decides a run.

    - `steps`, `minutes`: whichever ends first; `minutes` counts from the call of `fit`. A
      schedule that falls ends when the minutes do, by the number of steps that they were found
      to hold.
    - `train_frames`: frames drawn for their variety (0: all). Memory grows with their number, and
      not with that of the frames they are drawn from.
    - `frames_per_minute`: with `minutes`, no more frames than so many for each after the
      first (0: no limit).
    - `points`: how many points a frame gives, and where.
    - `frames_per_step`, `points_per_step` (of each frame).
    - `skinning_every`, `skinning_points`: with stored roots, every so many steps the skinning
      field is updated from so many points a frame; the other steps update the geometry.
    - `polish_every`: steps after which stored roots follow the skinning field, those of at most
      `polish_frames` frames at a time, in turn.
    - `redraw_every`, `redraw_frames`: every so many steps the points of so many frames are drawn
      anew, one frame after another (0: never).
    - `prefit_steps`: steps that fit the geometry to the body's mean shape first, cached.
    - `settle_steps`: steps that then teach the skinning field what its own terms ask for at the
      person's joints and surface, before any root is searched. A template on grids has it already.
    - `report_every`: steps after which terms are recorded, and log and callback are served.
    - `checkpoint_every`: steps after which a checkpoint is written, where one is asked for.
    """

    preset: str = "quick"
    seed: int = 0
    steps: int = 1500
    minutes: float | None = None
    train_frames: int = 200
    frames_per_minute: int = 60
    frames_per_step: int = 16
    points_per_step: int = 512
    skinning_every: int = 4
    skinning_points: int = 128
    polish_every: int = 400
    polish_frames: int = 256
    redraw_every: int = 0
    redraw_frames: int = 8
    prefit_steps: int = 200
    settle_steps: int = 2000
    report_every: int = 25
    checkpoint_every: int = 250
    points: SamplingPlan = SamplingPlan()
    skinning: SkinningConfig = SkinningConfig()
    geometry: GeometryConfig = GeometryConfig()
    search: SearchConfig = SearchConfig()
    losses: LossConfig = LossConfig()
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    validation: ValidationConfig = ValidationConfig()


def quick() -> FitConfig:
    """Minutes on two CPU cores: grid-encoded fields, roots found when points are drawn."""
    return FitConfig(
        points=SamplingPlan(
            body=2600,
            face=700,
            eyes_mouth=500,
            hand=1000,
            box=200,
            sigma=(0.003, 0.012),
            fine_sigma=(0.002, 0.008),
            by_vertex=False,
        ),
        losses=LossConfig(
            softness=0.004, joint=0.1, surface=100.0, surface_parts="all", surface_points=2048
        ),
        optimiser=OptimiserConfig(
            learning_rate=5e-3, skinning_rate=2e-2, schedule="cosine", clip=1.0, epsilon=1e-15
        ),
    )


def paper() -> FitConfig:
    """The paper's networks, losses, counts and schedule (released code where they differ)."""
    return FitConfig(
        preset="paper",
        steps=45_000,
        train_frames=0,
        frames_per_step=4,
        points_per_step=6000,
        prefit_steps=2000,
        settle_steps=0,
        checkpoint_every=1000,
        points=SamplingPlan(),
        skinning=SkinningConfig(kind="mlp"),
        geometry=GeometryConfig(kind="mlp"),
        search=SearchConfig(starts="paper", cached=False, keep=16, max_steps=50),
        losses=LossConfig(softness=0.0),
        optimiser=OptimiserConfig(warmup=1000),
        validation=ValidationConfig(every=500, patience=10_000),
    )


def for_programs(config: FitConfig) -> FitConfig:
    """The config with everything at its default that is read between steps alone.

    Runs that differ in nothing else share their compiled programs.
    """
    return FitConfig(
        seed=config.seed,
        frames_per_step=config.frames_per_step,
        skinning=config.skinning,
        geometry=config.geometry,
        search=config.search,
        losses=config.losses,
        optimiser=config.optimiser,
    )


PRESETS = {"quick": quick, "paper": paper}
"""Presets by name: functions that give a `FitConfig`."""


def has_guide(config: FitConfig) -> bool:
    """Whether searches run on a table of the skinning field first."""
    return not config.search.cached and config.search.guide_every > 0


def check_start(config: FitConfig) -> None:
    """**Raises:** `ValueError` for stored roots of a skinning field that starts at random."""
    if config.skinning.start == "random" and config.search.cached:
        raise ValueError(
            "skinning.start='random' with search.cached=True: roots are stored once, and those of "
            "a random field lead nowhere; set search.cached=False, so that each step searches"
        )


def config_to_dict(config: FitConfig) -> dict[str, Any]:
    """The config as plain values for JSON."""
    return asdict(config)


def config_from_dict(values: Mapping[str, Any]) -> FitConfig:
    """The config that `config_to_dict` gave, after a trip through JSON.

    **Raises:** `ValueError` naming an entry that this version does not know.
    """
    return _build(FitConfig, values, "config")


def _build(kind: Any, values: Mapping[str, Any], where: str) -> Any:
    known = {f.name: f for f in fields(kind)}
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ValueError(f"{where}: unknown entry {unknown[0]!r}; it may come from a newer version")
    hints = get_type_hints(kind)
    built = {}
    for name, value in values.items():
        if is_dataclass(hints[name]):
            value = _build(hints[name], value, f"{where}.{name}")
        elif isinstance(value, list):
            value = tuple(value)
        built[name] = value
    return kind(**built)
