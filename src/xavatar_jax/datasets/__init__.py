"""Captures: sequences of one person, from the datasets' own layouts or made by code."""

from .capture import Capture as Capture
from .folder import load_folder as load_folder
from .folder import load_frames as load_frames
from .grab import load_grab as load_grab
from .load import find_gender as find_gender
from .load import load_data as load_data
from .prepared import load_prepared as load_prepared
from .synthetic import synthetic_capture as synthetic_capture
from .synthetic import synthetic_capture_folder as synthetic_capture_folder
from .synthetic import write_synthetic_capture as write_synthetic_capture
