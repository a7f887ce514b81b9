"""Writing and reading of meshes."""

from xavatar_jax.export.meshes import read_mesh as read_mesh
from xavatar_jax.export.meshes import write_obj as write_obj
from xavatar_jax.export.meshes import write_ply as write_ply
