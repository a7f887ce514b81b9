"""Hand poses of files, mean-relative or by PCA, to absolute ones and back."""

from __future__ import annotations

import numpy as np
import pytest

from xavatar_jax.body import BodyParams, hands_to_absolute, hands_to_relative

FIRST = {"smplx": {"left": 25, "right": 40}, "smplh": {"left": 22, "right": 37}}


@pytest.mark.parametrize("kind", FIRST)
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("flat", [True, False])
def test_both_ways(family, family_arrays, rng, kind, side, flat):
    body = family[kind]
    mean = family_arrays[kind][f"hands_mean{side[0]}"].reshape(15, 3)
    relative = rng.normal(size=(4, 15, 3))
    given = relative.reshape(4, 45) if flat else relative
    absolute = hands_to_absolute(body, given, side)
    np.testing.assert_allclose(absolute, relative + mean, atol=1e-6)
    back = hands_to_relative(body, absolute, side)
    np.testing.assert_allclose(back, relative, atol=1e-6)
    # The mean stands at the joints of this hand.
    first = FIRST[kind][side]
    np.testing.assert_allclose(body.hand_mean[first : first + 15], mean, atol=1e-7)
    params = BodyParams.create(body, **{f"{side}_hand_pose": absolute})
    np.testing.assert_allclose(params.pose[:, first : first + 15], absolute)


@pytest.mark.parametrize("count", [6, 12, 24, 45])
@pytest.mark.parametrize("side", ["left", "right"])
def test_pca_coefficients(family, family_arrays, rng, side, count):
    arrays = family_arrays["smplx"]
    coefficients = rng.normal(size=(3, count)) if count < 45 else rng.normal(size=(3, 45))
    found = hands_to_absolute(family["smplx"], coefficients, side)
    expected = coefficients
    if count < 45:  # 45 numbers are a full pose
        expected = coefficients @ arrays[f"hands_components{side[0]}"][:count]
    expected = expected + arrays[f"hands_mean{side[0]}"]
    np.testing.assert_allclose(found, expected.reshape(3, 15, 3), atol=1e-5)


def test_mano(family, family_arrays, rng):
    relative = rng.normal(size=45)
    found = hands_to_absolute(family["mano"], relative, "right")
    expected = relative + family_arrays["mano"]["hands_mean"]
    np.testing.assert_allclose(found, expected.reshape(15, 3), atol=1e-6)


def test_hands_that_are_not_there(family):
    with pytest.raises(ValueError, match=r"smpl.*no left hand joints"):
        hands_to_absolute(family["smpl"], np.zeros(45), "left")
    with pytest.raises(ValueError, match="no left hand joints"):
        hands_to_relative(family["mano"], np.zeros((15, 3)), "left")
    with pytest.raises(ValueError, match=r"left_hand_pose has 50 numbers.*45 components"):
        hands_to_absolute(family["smplx"], np.zeros(50), "left")
