"""The curve against the standard's other direction, and what other parts rely on."""

import numpy as np
import pytest

from preface.srgb import decode, encode, light_of_levels


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_light_of_levels_undoes_the_srgb_encoding(dtype):
    light = light_of_levels(np.dtype(dtype)).astype(np.float64)
    levels = np.arange(len(light)) / (len(light) - 1)
    encoded = np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055
    )
    np.testing.assert_allclose(encoded, levels, atol=2e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_encoding_and_decoding_undo_each_other_in_their_precision(dtype):
    values = np.linspace(0, 1, 10_001, dtype=dtype)
    tolerance = 4e-7 if dtype == np.float32 else 2e-7  # the standard's two pieces meet to seven digits
    for there, back in ((encode, decode), (decode, encode)):
        assert there(values).dtype == dtype
        np.testing.assert_allclose(back(there(values)), values, atol=tolerance)


def test_the_ends_stay_and_the_middle_is_the_standards():
    np.testing.assert_allclose(encode(np.array([0.0, 1.0])), [0, 1], atol=2e-16)
    np.testing.assert_allclose(decode(np.array([0.0, 1.0])), [0, 1], atol=2e-16)
    assert abs(float(encode(np.array([0.5]))[0]) - 0.7353569830524495) < 1e-12
