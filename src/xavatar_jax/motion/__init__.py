"""Motion: a sequence of body poses with its frame rate and axes, read, changed and written."""

from .amass import save_amass as save_amass
from .bvh import save_bvh as save_bvh
from .editing import concat as concat
from .format import Format as Format
from .joint_names import JOINT_MAPS as JOINT_MAPS
from .pose_pickle import save_poses as save_poses
from .record import Motion as Motion
from .record import MotionNotice as MotionNotice
from .record import fit_to_body as fit_to_body
from .record import rest_pelvis as rest_pelvis
from .registry import FORMATS as FORMATS
from .registry import load_motion as load_motion
from .registry import save_motion as save_motion
from .xavatar import save_xavatar as save_xavatar
