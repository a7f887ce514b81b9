"""Posed meshes with body parameters: the observations an avatar is fitted to."""

from .frames import Frame as Frame
from .frames import Frames as Frames
from .frames import known_body as known_body
from .frames import spread as spread
from .posed import frames_from_params as frames_from_params
from .posed import nearest_part_labels as nearest_part_labels
from .posed import posed_vertices as posed_vertices
