"""Training: configs and presets, the objective, the jitted step, the loop."""

from .config import PRESETS as PRESETS
from .config import FitConfig as FitConfig
from .config import GeometryConfig as GeometryConfig
from .config import LossConfig as LossConfig
from .config import OptimiserConfig as OptimiserConfig
from .config import SearchConfig as SearchConfig
from .config import SkinningConfig as SkinningConfig
from .config import config_from_dict as config_from_dict
from .config import config_to_dict as config_to_dict
from .config import paper as paper
from .config import quick as quick
from .loop import Fitted as Fitted
from .loop import History as History
from .loop import TrainingError as TrainingError
from .loop import fit_fields as fit_fields
from .loop import subject_betas as subject_betas
from .model import AvatarFields as AvatarFields
from .model import as_dtype as as_dtype
from .model import fresh_fields as fresh_fields
from .model import settle_on_person as settle_on_person
from .model import trainable_filter as trainable_filter
from .prefit import initial_fields as initial_fields
