"""Captures: sequences of one person, read from the layouts of published datasets."""

from .capture import Capture as Capture
from .grab import load_grab as load_grab
from .load import find_gender as find_gender
from .load import load_data as load_data
from .scans import load_folder as load_folder
from .scans import load_frames as load_frames
from .scans import load_prepared as load_prepared
