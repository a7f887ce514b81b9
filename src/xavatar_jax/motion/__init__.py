"""Motion: a sequence of body poses with its frame rate and axes, read, changed and written."""

from xavatar_jax.motion.amass import load_motion as load_motion
from xavatar_jax.motion.amass import save_amass as save_amass
from xavatar_jax.motion.convert import MotionNotice as MotionNotice
from xavatar_jax.motion.convert import fit_to_body as fit_to_body
from xavatar_jax.motion.record import Motion as Motion
from xavatar_jax.motion.rotate import rest_pelvis as rest_pelvis
