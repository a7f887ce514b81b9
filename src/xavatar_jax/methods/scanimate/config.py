"""What a run of SCANimate is made of."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from ...fields import MLPShape
from ..snarf import snarf_quick
from ..xavatar.config import FitConfig, paper


@dataclass(frozen=True)
class StagePlan:
    """One of the three stages.

    - `steps`, `share`: the stage ends after these steps, or after its share of the minutes that are
      left once the scans are read (of shares that sum to one).
    - `frames` a step, and `points` of each: triangles of a scan.
    - `rate`: of learning; "cosine" falls to a hundredth, "steps" to a tenth at one half and again
      at three quarters.
    """

    steps: int
    share: float
    frames: int
    points: int
    rate: float
    schedule: Literal["cosine", "steps"] = "cosine"


@dataclass(frozen=True)
class SkinWeights:
    """Weights of the terms of stages 1 and 2.

    - `body`: template weights at the body's vertices, both nets; `scan`: at a scan's points, those
      of the nearest point of the body.
    - `sparsity`, `latent`: of the inverse net's weights, and of the frames' latent vectors.
    - `cycle`: a point carried to canonical space and back (ten times as much from one half of stage
      2, a hundred times from three quarters); `agreement`: of both nets; `edge`: of the inverse
      net's weights along a triangle. Stage 2 alone.
    """

    body: float = 10.0
    scan: float = 1.0
    sparsity: float = 1e-3
    latent: float = 0.01
    cycle: float = 0.1
    agreement: float = 1.0
    edge: float = 0.1


@dataclass(frozen=True)
class ShapeWeights:
    """Weights of the terms of stage 3; one of weight 0 is not computed.

    - `surface`: the distance is zero at canonical points of the scans; `normal`: its gradient is
      the normal there; `eikonal`: its gradient has length one, there, near scans and body, and in
      the box.
    - `offset`: the distance is the step at points that lie a step along the normal, drawn with the
      deviations `sigma` (metres) in turn. On grids it says what the two above say to networks, and
      takes no derivative of a derivative.
    - `empty`: no surface at points of the box; `faces`: the box's faces are outside.
    """

    surface: float = 1.0
    normal: float = 0.0
    eikonal: float = 0.0
    offset: float = 1.0
    sigma: tuple[float, ...] = (0.002, 0.006)
    empty: float = 0.1
    faces: float = 1.0


@dataclass(frozen=True)
class ScanimateConfig:
    """Everything that decides a run.

    - `minutes`: from the call, all stages together.
    - `train_frames`: frames drawn for their variety (0: all), with `minutes` no more than
      `frames_per_minute` for each after the first (0: no limit); `triangles`: kept of each,
      drawn by area.
    - `start`: fields that are fitted to the body's mean shape first, as those of `fit` are.
    - `forward`, `distance`: networks in place of the fields of `start` (None: those).
    - `inverse`: the inverse net, with a latent vector of `latent` numbers a frame; where `known`,
      it learns what is to be added to the logarithm of the weights at the body's nearest point.
    - `hands`: in stage 3 those of the body, fingers in the mean pose of the frames, or the scans',
      which a body-only skeleton leaves where they are.
    - `stretch`: a triangle with an edge that becomes this many times longer or shorter in canonical
      space is left out of stage 3: it spans parts that only touch.
    """

    seed: int = 0
    minutes: float | None = None
    train_frames: int = 100
    frames_per_minute: int = 60
    triangles: int = 1500
    start: FitConfig = snarf_quick()
    forward: MLPShape | None = None
    inverse: MLPShape = MLPShape(
        width=128, depth=3, octaves=4, skip=(), condition_at=(0,), condition_embedding=64
    )
    distance: MLPShape | None = None
    latent: int = 64
    known: bool = True
    hands: Literal["body", "scan"] = "body"
    stretch: float = 2.5
    clip: float = 1.0
    skin: StagePlan = StagePlan(steps=0, share=0.0, frames=8, points=128, rate=4e-3)
    cycle: StagePlan = StagePlan(steps=300, share=0.25, frames=8, points=128, rate=2e-3)
    shape: StagePlan = StagePlan(steps=1500, share=0.75, frames=16, points=256, rate=5e-3)
    skin_weights: SkinWeights = SkinWeights()
    shape_weights: ShapeWeights = ShapeWeights()

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def scanimate_quick() -> ScanimateConfig:
    """Minutes on two CPU cores: the grids of the preset `quick`, and a small inverse net.

    Stage 1 has no steps: the grids hold the template's weights, and the inverse net adds to them.
    """
    return ScanimateConfig()


def scanimate_paper() -> ScanimateConfig:
    """SCANimate's networks, losses and schedule (its public code's example)."""
    start = paper()
    start = replace(start, losses=replace(start.losses, softness=0.004))
    skinning = MLPShape(width=256, depth=3, octaves=4, skip=(2,), condition_at=())
    return ScanimateConfig(
        train_frames=0,
        triangles=8000,
        start=replace(start, preset="scanimate-paper"),
        forward=skinning,
        inverse=replace(skinning, condition_at=(0,), condition_embedding=64),
        distance=MLPShape(width=512, depth=6, octaves=4, skip=(4,), condition_embedding=512),
        known=False,
        skin=StagePlan(20_000, 0.2, 4, 2000, 4e-3, "steps"),
        cycle=StagePlan(20_000, 0.2, 4, 2000, 4e-5, "steps"),
        shape=StagePlan(40_000, 0.6, 1, 8000, 4e-3, "steps"),
        shape_weights=ShapeWeights(normal=1.0, eikonal=1.0, offset=0.0),
    )
