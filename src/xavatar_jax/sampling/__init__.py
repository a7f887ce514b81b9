"""Training points in the volume, on the surface and on the skeleton; choice of frames."""

from .frames import pose_distance as pose_distance
from .frames import varied_frames as varied_frames
from .points import SamplingPlan as SamplingPlan
from .points import SurfacePoints as SurfacePoints
from .points import VolumePoints as VolumePoints
from .points import bone_points as bone_points
from .points import joint_targets as joint_targets
from .points import signed_distance as signed_distance
from .points import surface_points as surface_points
from .points import volume_points as volume_points
