"""X-Avatar (Shen, Guo et al., CVPR 2023): part-aware correspondence search and sampling."""

from .config import ABLATIONS as ABLATIONS
from .config import PRESETS as PRESETS
from .config import FitConfig as FitConfig
from .config import LossConfig as LossConfig
from .config import OptimiserConfig as OptimiserConfig
from .config import SearchConfig as SearchConfig
from .config import ValidationConfig as ValidationConfig
from .config import paper as paper
from .config import quick as quick
from .fit import fit as fit
from .stages import PointBatch as PointBatch
