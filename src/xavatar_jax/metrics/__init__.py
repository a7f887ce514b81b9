"""Distances, normals and overlap of a mesh and the ground truth: all, hands and face."""

from .compare import surface_metrics as surface_metrics
from .record import REGIONS as REGIONS
from .record import MeshMetrics as MeshMetrics
from .record import RegionValues as RegionValues
from .record import mean_metrics as mean_metrics
from .record import null_if_nan as null_if_nan
