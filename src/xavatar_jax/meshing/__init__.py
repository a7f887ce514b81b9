"""Triangle meshes, and their extraction from level sets."""

from .extract import extract_surface as extract_surface
from .mesh import Mesh as Mesh
from .mesh import connected_components as connected_components
from .sampler import EmptyLevelSetError as EmptyLevelSetError
