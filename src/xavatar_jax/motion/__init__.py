"""Motion: a sequence of body poses with its frame rate and axes, read, changed and written."""

from .amass import load_motion as load_motion
from .amass import save_amass as save_amass
from .convert import MotionNotice as MotionNotice
from .convert import fit_to_body as fit_to_body
from .record import Motion as Motion
from .rotate import rest_pelvis as rest_pelvis
