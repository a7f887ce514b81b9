"""What a model is made of, as frozen dataclasses that are kept in an avatar's file as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any, Literal, TypeVar, get_type_hints

from .grids import GridSpacing
from .networks import MLPShape
from .skinning import PAPER_SKINNING

T = TypeVar("T")


@dataclass(frozen=True)
class SkinningSpec:
    """`kind`: template weights on part grids with a learned correction (`grid`), or the paper's
    network (`mlp`).

    - `start`: begin with the template's weights, or at random. Random grids have no template
      beneath the correction, whose spacing is then that of the field.
    - `around`: lay grids around the person's own shape, or around the mean shape.
    """

    kind: Literal["grid", "mlp"] = "grid"
    start: Literal["template", "random"] = "template"
    around: Literal["person", "mean"] = "person"
    grid: GridSpacing = GridSpacing(face=0.0054)
    correction: GridSpacing = GridSpacing(body=0.048, hands=0.012, face=0.024)
    mlp: MLPShape = PAPER_SKINNING

    @property
    def knows_template(self) -> bool:
        """Whether the field has the template's weights as soon as it is built."""
        return self.kind == "grid" and self.start == "template"


@dataclass(frozen=True)
class GeometrySpec:
    """`kind`: feature grids and a small network (`hash`), or the paper's network (`mlp`).

    - `spacing`: node distance of each level, metres. Levels finer than `trunk` are read only at
      the hands (down to `hands`) and the face (down to `face`).
    - `features`, `log2_size`: features and rows of a level's table.
    - `width`, `condition`: width of the small network, and of the pose features it reads.
    - `expression_spacing`, `expression_features`: the learned effect of expression on the face.
    - `expression_moves`: spacing of the grid that carries the field along with the body model's
      own expression (0: the field does not move).
    - `box_margin`: space around the body that the feature grids cover, metres.
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
class LinkSpec:
    """What the level of the geometry means; `softness` is the width of the surface in metres."""

    kind: Literal["occupancy", "signed_distance"] = "occupancy"
    softness: float = 0.004


@dataclass(frozen=True)
class ModelSpec:
    """Everything `build_model` needs besides the body."""

    skinning: SkinningSpec = SkinningSpec()
    geometry: GeometrySpec = GeometrySpec()
    link: LinkSpec = LinkSpec()

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ModelSpec:
        """The inverse of `to_dict`, also after a trip through JSON.

        **Raises:** `ValueError` naming an entry that this version does not know.
        """
        return dataclass_from_dict(cls, values, "spec")


def dataclass_from_dict(kind: type[T], values: Mapping[str, Any], name: str) -> T:
    """A (nested) frozen dataclass from what `asdict` gave, with tuples for JSON's lists.

    Missing entries take their defaults. **Raises:** `ValueError` naming an unknown entry; `name`
    is what the message calls the whole.
    """
    known: Any = kind
    unknown = sorted(set(values) - {f.name for f in fields(known)})
    if unknown:
        raise ValueError(f"{name}: unknown entry {unknown[0]!r}; it may come from a newer version")
    hints = get_type_hints(kind)

    def read(entry: str, value: Any) -> Any:
        if is_dataclass(hints[entry]):
            return dataclass_from_dict(hints[entry], value, f"{name}.{entry}")  # type: ignore
        return tuple(value) if isinstance(value, list) else value

    return kind(**{entry: read(entry, value) for entry, value in values.items()})
