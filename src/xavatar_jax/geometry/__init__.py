"""Queries on triangle meshes: closest points, winding numbers, normals, areas, samples."""

from .queries import ClosestPointTree as ClosestPointTree
from .queries import VertexTree as VertexTree
from .queries import WindingNumberTree as WindingNumberTree
from .queries import closest_points as closest_points
from .queries import nearest_vertices as nearest_vertices
from .queries import winding_number as winding_number
from .surface import check_mesh as check_mesh
from .surface import check_points as check_points
from .surface import corner_matrix as corner_matrix
from .surface import enclosed_volume as enclosed_volume
from .surface import face_areas as face_areas
from .surface import face_normals as face_normals
from .surface import sample_surface as sample_surface
from .surface import vertex_normals as vertex_normals
