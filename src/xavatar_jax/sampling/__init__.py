"""Points to learn from: labelled by winding number, drawn by part."""

from .bones import bone_points as bone_points
from .bones import joint_targets as joint_targets
from .frames import pose_distance as pose_distance
from .frames import varied_frames as varied_frames
from .labels import signed_distance as signed_distance
from .points import FrameSamples as FrameSamples
from .points import SamplingPlan as SamplingPlan
from .points import sample_frame as sample_frame
