"""The bundled body: a human made by code in the SMPL-X layout."""

from .build import SYNTHETIC_BODY_VERSION as SYNTHETIC_BODY_VERSION
from .build import build_synthetic_body as build_synthetic_body
from .build import write_synthetic_body as write_synthetic_body
from .colors import synthetic_colors as synthetic_colors
