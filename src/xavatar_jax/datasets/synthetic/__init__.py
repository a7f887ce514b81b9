"""The bundled capture: GRAB-like motion of one person, made by code."""

from xavatar_jax.datasets.synthetic.write import synthetic_capture as synthetic_capture
from xavatar_jax.datasets.synthetic.write import synthetic_motions as synthetic_motions
from xavatar_jax.datasets.synthetic.write import write_synthetic_capture as write_synthetic_capture
