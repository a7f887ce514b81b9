"""Posed meshes with the body parameters of each: what an avatar is learned from."""

from xavatar_jax.frames.frames import Frame as Frame
from xavatar_jax.frames.frames import Frames as Frames
from xavatar_jax.frames.posed import frames_from_params as frames_from_params
from xavatar_jax.frames.posed import nearest_part_labels as nearest_part_labels
from xavatar_jax.frames.posed import posed_vertices as posed_vertices
from xavatar_jax.frames.select import spread as spread
