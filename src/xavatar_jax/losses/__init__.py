"""Loss terms, elementwise: no mean and no weight, which belong to training."""

from .terms import binary_cross_entropy as binary_cross_entropy
from .terms import soft_occupancy as soft_occupancy
from .terms import squared_error as squared_error
