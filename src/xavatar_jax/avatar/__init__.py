"""Avatars: fit, query, pose, evaluate, save and load."""

from .animate import Animation as Animation
from .animate import AnimationAccuracy as AnimationAccuracy
from .avatar import Avatar as Avatar
from .evaluate import Evaluation as Evaluation
from .evaluate import Posable as Posable
from .evaluate import evaluate as evaluate
from .fit import Fit as Fit
from .fit import fit as fit
from .query import Query as Query
from .rigging import GlbExport as GlbExport
from .store import load_avatar as load_avatar
from .store import load_avatar_body as load_avatar_body
from .store import load_avatar_config as load_avatar_config
from .surface import CellSizes as CellSizes
