"""Triangle meshes, and their extraction from level sets."""

from xavatar_jax.meshing.dense import marching_cubes as marching_cubes
from xavatar_jax.meshing.extract import extract_surface as extract_surface
from xavatar_jax.meshing.mesh import Mesh as Mesh
from xavatar_jax.meshing.mesh import connected_components as connected_components
from xavatar_jax.meshing.sampler import EmptyLevelSetError as EmptyLevelSetError
