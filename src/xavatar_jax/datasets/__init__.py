"""Captures: sequences of one person, from the datasets' own layouts or made by code."""

from xavatar_jax.datasets.capture import Capture as Capture
from xavatar_jax.datasets.folder import load_folder as load_folder
from xavatar_jax.datasets.folder import load_frames as load_frames
from xavatar_jax.datasets.grab import load_grab as load_grab
from xavatar_jax.datasets.load import find_gender as find_gender
from xavatar_jax.datasets.load import load_data as load_data
from xavatar_jax.datasets.prepared import load_prepared as load_prepared
from xavatar_jax.datasets.synthetic import synthetic_capture as synthetic_capture
from xavatar_jax.datasets.synthetic import write_synthetic_capture as write_synthetic_capture
