"""Queries on triangle meshes: winding numbers, closest points, normals, samples."""

from xavatar_jax.geometry._check import check_mesh as check_mesh
from xavatar_jax.geometry._check import check_points as check_points
from xavatar_jax.geometry.libigl import ClosestPointTree as ClosestPointTree
from xavatar_jax.geometry.libigl import WindingNumberTree as WindingNumberTree
from xavatar_jax.geometry.libigl import closest_points as closest_points
from xavatar_jax.geometry.libigl import winding_number as winding_number
from xavatar_jax.geometry.nearest import nearest_vertices as nearest_vertices
from xavatar_jax.geometry.surface import enclosed_volume as enclosed_volume
from xavatar_jax.geometry.surface import face_areas as face_areas
from xavatar_jax.geometry.surface import face_normals as face_normals
from xavatar_jax.geometry.surface import sample_surface as sample_surface
from xavatar_jax.geometry.surface import vertex_normals as vertex_normals
