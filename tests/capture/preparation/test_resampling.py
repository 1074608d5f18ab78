import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.capture.preparation import (
    PreparationError,
    PreparationOptions,
    Resampler,
    Window,
    framing_window,
    split_alpha,
)
from preface.geometry import Camera

FILTERS = ["area", "lanczos", "bilinear"]
LIGHTS = ["linear", "encoded"]


def pinhole(width, height):
    return Camera("PINHOLE", width, height, [1000, 1000, width / 2, height / 2])


def resampler(width, height, size, window=None, **options):
    return Resampler(
        pinhole(width, height), size, window or Window(0, 0, width, height), PreparationOptions(**options)
    )


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def light_of(encoded):
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def covered_parts(length, start, span, count):
    """Row i: how much of result pixel i each source pixel covers; brute force."""
    edges = start + np.arange(count + 1) * span / count
    pixels = np.arange(length)
    parts = np.minimum(pixels + 1, edges[1:, None]) - np.maximum(pixels, edges[:-1, None])
    return np.maximum(parts, 0) * count / span


def oracle(encoded, window, size, light):
    """The exact mean of what every pixel covers, float64; encoded is [h, w, c] in [0, 1]."""
    values = light_of(encoded) if light == "linear" else encoded
    down = covered_parts(values.shape[0], window.y, window.height, size[1])
    across = covered_parts(values.shape[1], window.x, window.width, size[0])
    mean = np.einsum("ih,hwc,jw->ijc", down, values, across, optimize=True)
    return srgb(mean) if light == "linear" else mean


def noise(height, width, dtype, channels=3, seed=0):
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return rng.uniform(0, 1, (height, width, channels)).astype(dtype)
    return rng.integers(0, np.iinfo(dtype).max, (height, width, channels), dtype, endpoint=True)


def as_encoded(pixels):
    if pixels.dtype.kind == "f":
        return srgb(pixels.astype(np.float64))
    return pixels / np.iinfo(pixels.dtype).max


@st.composite
def cases(draw):
    width, height = draw(st.integers(1, 70)), draw(st.integers(1, 70))
    across, down = draw(st.floats(1, width)), draw(st.floats(1, height))
    window = Window(
        draw(st.floats(0, 1)) * (width - across), draw(st.floats(0, 1)) * (height - down), across, down
    )
    return width, height, window, (draw(st.integers(1, int(across))), draw(st.integers(1, int(down))))


@settings(max_examples=50, deadline=None)
@given(
    cases(),
    st.sampled_from([np.uint8, np.uint16, np.float16, np.float32]),
    st.sampled_from(LIGHTS),
    st.sampled_from([1, 3]),
)
def test_colours_are_the_exact_area_means_rounded(case, dtype, light, channels):
    width, height, window, size = case
    pixels = noise(height, width, dtype, channels)
    found = resampler(width, height, size, window, light=light).colors(pixels)
    wanted = 255 * oracle(as_encoded(pixels), window, size, light)
    assert found.dtype == np.uint8
    assert found.shape == (size[1], size[0], 3)
    # A half-way value may fall to either side by the rounding of float32 sums.
    assert np.abs(found - wanted).max() <= 0.5 + 2e-3


@settings(max_examples=30, deadline=None)
@given(cases(), st.sampled_from(FILTERS), st.sampled_from(LIGHTS), st.integers(0, 255))
def test_a_constant_picture_stays_constant(case, filter, light, level):
    width, height, window, size = case
    plan = resampler(width, height, size, window, filter=filter, light=light)
    for pixels in (
        np.full((height, width, 3), level, np.uint8),
        np.full((height, width, 3), level * 257, np.uint16),
        np.full((height, width, 3), light_of(level / 255), np.float32),
    ):
        np.testing.assert_array_equal(plan.colors(pixels), level)
    np.testing.assert_array_equal(plan.coverage(np.full((height, width), level, np.uint8)), level)
    np.testing.assert_array_equal(plan.coverage(np.full((height, width), level / 255, np.float32)), level)


def test_light_is_averaged_not_its_encoding():
    board = np.zeros((32, 32, 3), np.uint8)
    board[::2, ::2] = board[1::2, 1::2] = 255  # half the light of white: 188, as from afar
    assert (resampler(32, 32, (4, 4)).colors(board) == 188).all()
    assert (resampler(32, 32, (4, 4), light="encoded").colors(board) == 128).all()


@pytest.mark.parametrize("filter", FILTERS)
def test_at_full_size_nothing_changes(filter):
    pixels = noise(40, 30, np.uint8)
    np.testing.assert_array_equal(resampler(30, 40, (30, 40), filter=filter).colors(pixels), pixels)


def test_area_keeps_the_total_of_alpha():
    alpha = np.random.default_rng(3).uniform(0, 1, (211, 173)).astype(np.float32)
    found = resampler(173, 211, (19, 23)).coverage(alpha)
    assert abs(found.mean() / 255 - alpha.mean()) < 0.5 / 255 / np.sqrt(19 * 23) * 4


def test_a_mask_is_covered_by_parts():
    alpha = np.zeros((16, 16), np.uint8)
    alpha[:, :10] = 255
    np.testing.assert_array_equal(
        resampler(16, 16, (2, 2)).coverage(alpha), [[255, 64]] * 2
    )  # 2 of 8 columns


def test_lanczos_is_sharper_than_area_and_cut_off_where_it_rings():
    step = np.zeros((8, 64, 3), np.uint8)
    step[:, 32:] = 255
    sharp = resampler(64, 8, (8, 1), filter="lanczos").colors(step)[0, :, 0]
    np.testing.assert_array_equal(sharp[[0, 7]], [0, 255])
    wave = 128 + 100 * np.sin(2 * np.pi * np.arange(64) / 12)  # three result pixels long
    grey = np.broadcast_to(wave[:, None], (64, 64)).astype(np.uint8)
    spread = [
        resampler(64, 64, (16, 16), filter=filter).colors(grey).astype(float).std()
        for filter in ("area", "lanczos")
    ]
    assert spread[1] > spread[0]


# ------------------------------------------------------------------------------ kinds of input


def test_grey_becomes_three_equal_channels_with_or_without_an_axis():
    grey = noise(12, 10, np.uint8, 1)
    plan = resampler(10, 12, (5, 6))
    wanted = plan.colors(np.repeat(grey, 3, axis=2))
    np.testing.assert_array_equal(plan.colors(grey), wanted)
    np.testing.assert_array_equal(plan.colors(grey[..., 0]), wanted)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32])
def test_alpha_is_a_mask_and_does_not_touch_colours(dtype):
    rgba = noise(12, 10, dtype, 4)
    plan = resampler(10, 12, (5, 6))
    colour, alpha = split_alpha(rgba)
    np.testing.assert_array_equal(colour, rgba[..., :3])
    np.testing.assert_array_equal(alpha, rgba[..., 3])
    np.testing.assert_array_equal(plan.colors(rgba), plan.colors(colour))
    top = 1 if np.dtype(dtype).kind == "f" else np.iinfo(dtype).max
    mean = (alpha.astype(np.float64) / top).reshape(6, 2, 5, 2).mean((1, 3))
    assert np.abs(plan.coverage(alpha) - 255 * mean).max() <= 0.5 + 1e-3


def test_images_without_alpha_have_none():
    for channels in (1, 3):
        pixels = noise(4, 4, np.uint8, channels)
        colour, alpha = split_alpha(pixels)
        assert colour is pixels
        assert alpha is None


def test_views_of_larger_arrays_are_prepared_as_their_copies():
    large = noise(40, 60, np.uint8, 4)
    part = large[3:35, 5:45, 2::-1]
    plan = resampler(40, 32, (9, 7), Window(1.5, 2, 36, 28))
    np.testing.assert_array_equal(plan.colors(part), plan.colors(part.copy()))


def test_exr_light_of_a_photograph_gives_the_same_bytes_as_the_photograph():
    levels = noise(48, 64, np.uint8)
    light = (light_of(levels / 255) * 3).astype(np.float32)
    np.testing.assert_array_equal(
        resampler(64, 48, (16, 12), white=3.0).colors(light), resampler(64, 48, (16, 12)).colors(levels)
    )


def test_highlights_are_cut_off_before_they_are_averaged():
    light = np.zeros((4, 4, 3), np.float32)
    light[0, 0] = 1000.0  # one lamp among sixteen pixels, as a sensor would clip it
    assert (resampler(4, 4, (1, 1)).colors(light) == round(255 * float(srgb(np.array(1 / 16))))).all()


# ----------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((12, 10, 2), np.uint8), ((12, 10, 5), np.uint8), ((12, 10, 3), np.int16), ((12, 10, 3), np.float64)],
)
def test_what_is_no_picture_is_refused(shape, dtype):
    with pytest.raises(PreparationError, match=r"pixels: shape .* no such image; give \[h, w, c\]"):
        resampler(10, 12, (5, 6)).colors(np.zeros(shape, dtype))


def test_a_photograph_of_another_size_than_the_rig_says_is_refused():
    with pytest.raises(PreparationError, match=r"pixels: 12x10 is not the camera's 10x12; .*rig"):
        resampler(10, 12, (5, 6)).colors(np.zeros((10, 12, 3), np.uint8))


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan, np.inf])
def test_an_alpha_that_is_no_share_is_refused(value):
    alpha = np.full((12, 10), 0.5, np.float32)
    alpha[3, 4] = value
    with pytest.raises(PreparationError, match=r"alpha: has values .*; give shares from 0 to 1"):
        resampler(10, 12, (5, 6)).coverage(alpha)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("filter", FILTERS)
def test_light_that_is_no_number_is_refused_wherever_it_is_read(value, dtype, filter):
    light = noise(12, 10, dtype)
    light[0:6, 2:8, 1] = value
    with pytest.raises(PreparationError, match=r"pixels: hold .*; export the image again"):
        resampler(10, 12, (5, 6), filter=filter).colors(light)


@pytest.mark.parametrize(
    "options",
    [{"filter": "cubic"}, {"light": "gamma"}, {"undistort": "no"}, {"white": 0.0}, {"white": np.nan}],
)
def test_options_that_do_not_exist_are_refused(options):
    with pytest.raises(PreparationError, match=f"{next(iter(options))}: "):
        PreparationOptions(**options)


def test_the_description_is_json_and_names_what_was_chosen():
    described = json.loads(json.dumps(resampler(64, 48, (16, 12), filter="lanczos").describe()))
    assert described["filter"] == "lanczos"
    assert described["undistort"] == "kept"
    assert described["window"] == [0, 0, 64, 48]
    assert described["size"] == [16, 12]


# ----------------------------------------------------------------------------------- extremes


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("filter", ["area", "lanczos"])
def test_a_whole_photograph_becomes_one_pixel(filter, light):
    pixels = noise(601, 403, np.uint8)
    found = resampler(403, 601, (1, 1), filter=filter, light=light).colors(pixels)
    if filter == "area":
        wanted = 255 * oracle(pixels / 255, Window(0, 0, 403, 601), (1, 1), light)
        assert np.abs(found - wanted).max() <= 0.51
    assert found.shape == (1, 1, 3)


def test_pictures_of_one_row_or_column_work():
    for width, height in ((1, 301), (301, 1), (1, 1)):
        pixels = noise(height, width, np.uint8)
        found = resampler(width, height, (1, 1)).colors(pixels)
        assert np.abs(found[0, 0] - 255 * srgb(light_of(pixels / 255).mean((0, 1)))).max() <= 0.51


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535), (np.float16, 65504)])
def test_saturated_and_black_pictures_keep_their_ends(filter, dtype, top):
    plan = resampler(37, 53, (5, 7), filter=filter)
    assert (plan.colors(np.full((53, 37, 3), top, dtype)) == 255).all()
    assert (plan.colors(np.zeros((53, 37, 3), dtype)) == 0).all()


def test_whole_framings_that_differ_by_a_fraction_of_a_pixel_are_exact_per_axis():
    camera = pinhole(301, 450)
    window = framing_window(camera, (30, 45), "whole")
    pixels = noise(450, 301, np.uint8)
    found = Resampler(camera, (30, 45), window).colors(pixels)
    assert np.abs(found - 255 * oracle(pixels / 255, window, (30, 45), "linear")).max() <= 0.502


def test_ratios_next_to_a_whole_number_are_not_rounded_to_it():
    pixels = noise(64, 64, np.uint8)
    for span in (64 - 1e-9, 64 - 1e-3, 63.5):
        window = Window(0, 0, span, span)
        found = resampler(64, 64, (8, 8), window).colors(pixels)
        assert np.abs(found - 255 * oracle(pixels / 255, window, (8, 8), "linear")).max() <= 0.502
