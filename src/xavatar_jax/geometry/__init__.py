"""Queries on triangle meshes: winding numbers, closest points, normals, samples."""

from ._check import check_mesh as check_mesh
from ._check import check_points as check_points
from .libigl import ClosestPointTree as ClosestPointTree
from .libigl import WindingNumberTree as WindingNumberTree
from .libigl import closest_points as closest_points
from .libigl import winding_number as winding_number
from .nearest import nearest_vertices as nearest_vertices
from .surface import corner_matrix as corner_matrix
from .surface import enclosed_volume as enclosed_volume
from .surface import face_areas as face_areas
from .surface import face_normals as face_normals
from .surface import sample_surface as sample_surface
from .surface import vertex_normals as vertex_normals
