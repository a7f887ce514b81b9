"""SCANimate: forward and inverse skinning networks that agree (Saito et al., CVPR 2021)."""

from .config import ScanimateConfig as ScanimateConfig
from .config import ShapeWeights as ShapeWeights
from .config import SkinWeights as SkinWeights
from .config import StagePlan as StagePlan
from .config import scanimate_paper as scanimate_paper
from .config import scanimate_quick as scanimate_quick
from .fit import fit_scanimate as fit_scanimate
