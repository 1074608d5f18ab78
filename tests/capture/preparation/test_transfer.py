import numpy as np
import pytest

from preface.capture.preparation import PreparationError, cut_off
from preface.capture.preparation.transfer import bytes_of_light, bytes_of_values, reader
from preface.srgb import decode, encode, light_of_levels


def srgb(light):
    """IEC 61966-2-1, one value at a time."""
    return 12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055


def light_of(encoded):
    return encoded / 12.92 if encoded <= 0.04045 else ((encoded + 0.055) / 1.055) ** 2.4


def read(pixels, meaning="linear", white=1.0):
    out = np.empty(pixels.shape, np.float32)
    reader(pixels.dtype, meaning, white)(pixels, out)
    return out


def test_bytes_are_the_nearest_to_the_encoded_light_everywhere():
    light = np.linspace(0, 1, 200_001, dtype=np.float32)
    wanted = [round(255 * srgb(float(value))) for value in light[::17]]
    np.testing.assert_array_equal(bytes_of_light(light[::17]), wanted)


def test_bytes_change_at_exactly_the_middle_between_two_levels():
    middles = np.array([light_of((level + 0.5) / 255) for level in range(255)])
    rounded = middles.astype(np.float32)
    above = np.where(rounded >= middles, rounded, np.nextafter(rounded, np.float32(2)))
    below = np.where(rounded < middles, rounded, np.nextafter(rounded, np.float32(0)))
    np.testing.assert_array_equal(bytes_of_light(above), np.arange(1, 256))
    np.testing.assert_array_equal(bytes_of_light(below), np.arange(255))


def test_every_byte_survives_the_way_to_light_and_back():
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(bytes_of_light(read(levels)), levels)
    np.testing.assert_array_equal(bytes_of_values(read(levels, "encoded")), levels)


def test_sixteen_bits_are_srgb_encoded_from_end_to_end():
    levels = np.array([0, 1, 128 * 257, 65534, 65535], np.uint16)
    np.testing.assert_allclose(read(levels), [light_of(value / 65535) for value in levels], rtol=1e-5)
    np.testing.assert_allclose(read(levels, "encoded"), levels / 65535, rtol=1e-6)
    widened = (np.arange(256) * 257).astype(np.uint16)
    np.testing.assert_array_equal(bytes_of_light(read(widened)), np.arange(256))


def test_what_is_out_of_range_becomes_the_nearest_end():
    light = np.array([-1e30, -1e-9, 0, 1, 1 + 1e-6, 1e30], np.float32)
    np.testing.assert_array_equal(bytes_of_light(light), [0, 0, 0, 255, 255, 255])
    np.testing.assert_array_equal(bytes_of_values(light), [0, 0, 0, 255, 255, 255])


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_float_light_is_scaled_by_white_and_cut_off(dtype):
    light = np.array([-0.5, 0, 0.25, 2, 4, 60000], dtype)
    np.testing.assert_allclose(read(light, white=4.0), [0, 0, 0.0625, 0.5, 1, 1])
    counted = cut_off(light, 4.0)
    assert (counted.above_white, counted.below_black) == (1 / 6, 1 / 6)
    np.testing.assert_allclose(
        read(light, "encoded", 4.0), [srgb(value) for value in (0, 0, 0.0625, 0.5, 1, 1)], atol=1e-6
    )


def test_integers_are_never_cut_off():
    counted = cut_off(np.array([0, 255], np.uint8), 0.5)
    assert (counted.above_white, counted.below_black) == (0, 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_light_that_is_no_finite_number_is_refused(dtype, value):
    with pytest.raises(PreparationError, match=r"pixels: hold (nan|inf|-inf).*finite number"):
        read(np.array([[0.5, value]], dtype))


def test_encoding_and_decoding_follow_the_standard_and_undo_each_other():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(encode(values), [srgb(value) for value in values], atol=1e-15)
    np.testing.assert_allclose(decode(values), [light_of(value) for value in values], atol=1e-15)
    np.testing.assert_allclose(decode(encode(values)), values, atol=1e-7)
    np.testing.assert_allclose(light_of_levels(np.dtype(np.uint8)), decode(np.arange(256) / 255), rtol=1e-5)
