"""The bundled capture: GRAB-like motion of one person, made by code."""

from .write import synthetic_capture as synthetic_capture
from .write import synthetic_capture_folder as synthetic_capture_folder
from .write import synthetic_motions as synthetic_motions
from .write import write_synthetic_capture as write_synthetic_capture
