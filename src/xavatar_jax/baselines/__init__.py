"""Other methods on the same interfaces: SNARF and SCANimate, both on a body-only skeleton."""

from .baseline import Baseline as Baseline
from .scanimate import ScanimateConfig as ScanimateConfig
from .scanimate import fit_scanimate as fit_scanimate
from .scanimate import scanimate_paper as scanimate_paper
from .scanimate import scanimate_quick as scanimate_quick
from .scanimate import start_fields as start_fields
from .skeleton import body_only as body_only
from .skeleton import body_only_frames as body_only_frames
from .skeleton import body_only_params as body_only_params
from .skeleton import kept_joints as kept_joints
from .snarf import fit_snarf as fit_snarf
from .snarf import snarf_paper as snarf_paper
from .snarf import snarf_quick as snarf_quick
