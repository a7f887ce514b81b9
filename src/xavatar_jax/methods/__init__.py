"""Methods that learn an avatar, on the same fields, search and training loop."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from .result import Fit as Fit
from .scanimate import fit_scanimate as fit_scanimate
from .scanimate import scanimate_paper as scanimate_paper
from .scanimate import scanimate_quick as scanimate_quick
from .snarf import fit_snarf as fit_snarf
from .snarf import snarf_paper as snarf_paper
from .snarf import snarf_quick as snarf_quick
from .xavatar import PRESETS as PRESETS
from .xavatar import fit as fit


@dataclass(frozen=True)
class Method:
    """A method by name: its `fit(frames, config, ...) -> Fit`, and its configs by preset."""

    fit: Callable[..., Fit]
    presets: Mapping[str, Callable[[], Any]]


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "xavatar": Method(fit, PRESETS),
        "snarf": Method(fit_snarf, {"quick": snarf_quick, "paper": snarf_paper}),
        "scanimate": Method(fit_scanimate, {"quick": scanimate_quick, "paper": scanimate_paper}),
    }
)
"""What `xavatar fit --method` offers."""
