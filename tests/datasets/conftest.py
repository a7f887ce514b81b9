import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "frames"))

from toy_smplx import write_toy_body

from xavatar_jax.body import load_body


@pytest.fixture(scope="session")
def toy_body(tmp_path_factory):
    """A small body of capsules, read through the ordinary loader."""
    return load_body(
        write_toy_body(tmp_path_factory.mktemp("toy") / "SMPLX_NEUTRAL.npz"),
        num_betas=10,
        num_expression=10,
    )
