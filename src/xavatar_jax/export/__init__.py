"""Writing and reading of meshes."""

from .meshes import read_mesh as read_mesh
from .meshes import write_obj as write_obj
from .meshes import write_ply as write_ply
