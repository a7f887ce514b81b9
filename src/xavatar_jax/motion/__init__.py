"""Motion: a sequence of body poses with its frame rate and axes, read, changed and written."""

from .amass import save_amass as save_amass
from .bvh import save_bvh as save_bvh
from .bvh_joints import JOINT_MAPS as JOINT_MAPS
from .convert import MotionNotice as MotionNotice
from .convert import fit_to_body as fit_to_body
from .editing import concat as concat
from .format import Format as Format
from .pose_pickle import save_poses as save_poses
from .record import Motion as Motion
from .registry import FORMATS as FORMATS
from .registry import load_motion as load_motion
from .registry import save_motion as save_motion
from .rotate import rest_pelvis as rest_pelvis
from .xavatar import save_xavatar as save_xavatar
