"""Distances, normals and overlap between a mesh and the truth: whole, hands and face."""

from xavatar_jax.metrics.evaluate import surface_metrics as surface_metrics
from xavatar_jax.metrics.record import REGIONS as REGIONS
from xavatar_jax.metrics.record import MeshMetrics as MeshMetrics
from xavatar_jax.metrics.record import RegionValues as RegionValues
from xavatar_jax.metrics.record import mean_metrics as mean_metrics
from xavatar_jax.metrics.record import null_if_nan as null_if_nan
