"""Write and read meshes, mesh sequences and animated rigs."""

from .glb import check_glb_path as check_glb_path
from .glb import glb_bytes as glb_bytes
from .glb import write_glb as write_glb
from .meshes import SequenceFormat as SequenceFormat
from .meshes import read_mesh as read_mesh
from .meshes import write_obj as write_obj
from .meshes import write_ply as write_ply
from .meshes import write_sequence as write_sequence
from .rig import Clip as Clip
from .rig import Influences as Influences
from .rig import Rig as Rig
from .rig import joint_worlds as joint_worlds
from .rig import limit_influences as limit_influences
from .rig import rotation_quaternions as rotation_quaternions
from .rig import write_weights as write_weights
