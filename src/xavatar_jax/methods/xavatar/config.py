"""The options of X-Avatar as frozen dataclasses, and presets as values of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

from ...correspondence import StartSet
from ...fields import (
    GeometrySpec,
    GridSpacing,
    LinkSpec,
    ModelSpec,
    SkinningSpec,
    dataclass_from_dict,
)
from ...sampling import SamplingPlan

QUICK_POINTS = SamplingPlan(
    body=2600,
    face=700,
    eyes_mouth=500,
    hand=1000,
    box=200,
    sigma=(0.003, 0.012),
    fine_sigma=(0.002, 0.008),
    by_vertex=False,
)
"""The points that the preset `quick` draws of a frame."""


@dataclass(frozen=True)
class SearchConfig:
    """Where roots come from.

    - `starts`: the bones that start a point's search.
    - `cached`: search once, on the tabulated field, when points are drawn, and polish the roots
      between steps; otherwise search in every training step.
    - `guide_every`: steps between two renewals of the table on which a search in the step begins
      (0: no table).
    - `grid`: the grids of the table; `keep`: roots kept for a point; `atol`: metres.
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
    """Weights of the loss terms.

    - `softness`: the width of the occupancy step at the surface, metres (0: hard labels).
    - `surface_parts`: the canonical vertices at which the skinning is held to the template's: those
      of hands and face, as in the released code, or all.
    - `surface_points`: how many of them are drawn for a step (0: all).
    """

    softness: float = 0.004
    bone: float = 1.0
    joint: float = 0.1
    surface: float = 100.0
    surface_parts: Literal["hands_face", "all"] = "all"
    surface_points: int = 2048


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam with a global-norm clip. A cosine schedule falls to a hundredth of the rate.

    - `learning_rate`: of the geometry field, and of both fields in the fits before training;
      `skinning_rate`: of the skinning field in training.
    - `warmup`: steps over which the rates rise.
    """

    learning_rate: float = 5e-3
    skinning_rate: float = 2e-2
    schedule: Literal["constant", "cosine"] = "cosine"
    clip: float = 1.0
    epsilon: float = 1e-15
    warmup: int = 0


@dataclass(frozen=True)
class ValidationConfig:
    """Frames that training does not learn from: they decide when it stops and what is kept.

    - `share`: of each training sequence, from its end; a sequence shorter than `1 / share` gives
      none. 0: no validation, and the last model is kept.
    - `frames`: how many of these are used, spread over the sequences; `points`: of each.
    - `every`, `patience`, `gain`: see `learning.Validation`.
    """

    share: float = 0.1
    frames: int = 12
    points: int = 512
    every: int = 50
    patience: int = 300
    gain: float = 0.005


@dataclass(frozen=True)
class FitConfig:
    """Everything that decides a run. The defaults are the preset `quick`.

    - `steps`, `minutes`: whichever ends first; `minutes` counts from the call of `fit`.
    - `train_frames`: frames to learn from, chosen for their variety (0: all). Memory grows with
      their number, not with that of the frames they are chosen from.
    - `frames_per_minute`: limit on the frames for each of the `minutes` after the first
      (0: no limit).
    - `points`: how many points of a frame are drawn, and where.
    - `frames_per_step`, `points_per_step` (of each frame).
    - `learn_skinning`: whether the skinning field is learned.
    - `skinning_every`, `skinning_points`: with cached roots, steps between two updates of the
      skinning field, and points of each frame in such a step. The other steps update the geometry.
    - `polish_every`, `polish_frames`: steps between two rounds in which cached roots follow the
      skinning field, and frames in a round.
    - `redraw_every`, `redraw_frames`: steps between two rounds in which points are drawn again
      (0: never), and frames in a round.
    - `prefit_steps`: steps that fit the model to the body's mean shape first; the result is cached.
    - `weights_steps`: steps that then fit a skinning network to the person's joints and surface
      before any root is searched. Template grids need none.
    - `report_every`, `checkpoint_every`: see `learning.Schedule`.
    """

    preset: str = "quick"
    seed: int = 0
    steps: int = 1500
    minutes: float | None = None
    train_frames: int = 200
    frames_per_minute: int = 60
    frames_per_step: int = 16
    points_per_step: int = 512
    learn_skinning: bool = True
    skinning_every: int = 4
    skinning_points: int = 128
    polish_every: int = 400
    polish_frames: int = 256
    redraw_every: int = 0
    redraw_frames: int = 8
    prefit_steps: int = 200
    weights_steps: int = 2000
    report_every: int = 25
    checkpoint_every: int = 250
    points: SamplingPlan = QUICK_POINTS
    skinning: SkinningSpec = SkinningSpec()
    geometry: GeometrySpec = GeometrySpec()
    search: SearchConfig = SearchConfig()
    losses: LossConfig = LossConfig()
    optimiser: OptimiserConfig = OptimiserConfig()
    validation: ValidationConfig = ValidationConfig()

    def __post_init__(self) -> None:
        if self.skinning.start == "random" and self.search.cached:
            raise ValueError(
                "skinning.start='random' needs search.cached=False: cached roots are found once, "
                "and those of a random field are meaningless"
            )

    @property
    def spec(self) -> ModelSpec:
        """The model that this run learns."""
        return ModelSpec(self.skinning, self.geometry, LinkSpec("occupancy", self.losses.softness))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> FitConfig:
        """The inverse of `to_dict`, also after a trip through JSON.

        **Raises:** `ValueError` naming an entry that this version does not know.
        """
        return dataclass_from_dict(cls, values, "config")


def quick() -> FitConfig:
    """Minutes on two CPU cores: fields on grids, and roots found when points are drawn."""
    return FitConfig()


def paper() -> FitConfig:
    """The paper's networks, losses, counts and schedule (released code where they differ)."""
    return FitConfig(
        preset="paper",
        steps=45_000,
        train_frames=0,
        frames_per_step=4,
        points_per_step=6000,
        prefit_steps=2000,
        weights_steps=0,
        checkpoint_every=1000,
        points=SamplingPlan(),
        skinning=SkinningSpec(kind="mlp"),
        geometry=GeometrySpec(kind="mlp"),
        search=SearchConfig(starts="paper", cached=False, keep=16, max_steps=50),
        losses=LossConfig(
            softness=0.0, joint=10.0, surface=10.0, surface_parts="hands_face", surface_points=0
        ),
        optimiser=OptimiserConfig(
            learning_rate=1e-3, skinning_rate=1e-3, schedule="constant", clip=0.1, epsilon=1e-8,
            warmup=1000,
        ),
        validation=ValidationConfig(every=500, patience=10_000),
    )  # fmt: skip


PRESETS: Mapping[str, Callable[[], FitConfig]] = MappingProxyType({"quick": quick, "paper": paper})
"""Presets by name."""


def body_starts(config: FitConfig) -> FitConfig:
    """A1: the search of every point starts at the body's bones."""
    return replace(config, search=replace(config.search, starts="body"))


def all_starts(config: FitConfig) -> FitConfig:
    """A2: the search of every point starts at all bones; sampling stays part-aware."""
    return replace(config, search=replace(config.search, starts="all_bones"))


def uniform_sampling(config: FitConfig) -> FitConfig:
    """A3: as many points, drawn from the whole surface regardless of part; starts stay by part."""
    return replace(config, points=replace(config.points, uniform=True))


def no_surface_term(config: FitConfig) -> FitConfig:
    """A4: no term holds the weights at the surface; the term at the joints stays."""
    return replace(
        config,
        losses=replace(config.losses, surface=0.0),
        skinning=replace(config.skinning, around="mean"),
    )


ABLATIONS: Mapping[str, Callable[[FitConfig], FitConfig]] = MappingProxyType(
    {"A1": body_starts, "A2": all_starts, "A3": uniform_sampling, "A4": no_surface_term}
)
"""The paper's ablations (table 1): each changes one thing of a config."""
