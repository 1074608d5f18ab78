import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.capture.preparation import (
    PreparationError,
    PreparationOptions,
    Resampler,
    Window,
    camera_of_window,
    framing_window,
)
from preface.geometry import Camera

STUDIO = Camera("OPENCV", 4096, 6144, [13500, 13400, 2040.3, 3080.9, -0.1, 0.05, 1e-4, -2e-4])
LENSES = [
    ("PINHOLE", [900, 880, 201, 148]),
    ("SIMPLE_RADIAL", [900, 201, 148, -0.1]),
    ("RADIAL", [900, 201, 148, -0.1, 0.02]),
    ("OPENCV", [900, 880, 201, 148, -0.1, 0.02, 1e-3, -2e-3]),
    ("FULL_OPENCV", [900, 880, 201, 148, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.02, 0.01, 0.003]),
]


def box_corners(center, half):
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(8, 3)
    return np.asarray(center) + signs * half


def whole_pixel_area(window):
    return (window.x, window.y, window.width, window.height)


# ------------------------------------------------------------------------------------- framing


def test_the_whole_photograph_is_framed_from_corner_to_corner():
    assert whole_pixel_area(framing_window(STUDIO, (512, 768), "whole")) == (0, 0, 4096, 6144)


def test_an_aspect_that_differs_by_less_than_half_a_pixel_counts_as_the_same():
    camera = Camera("PINHOLE", 1001, 1500, [1000, 1000, 500, 750])
    assert whole_pixel_area(framing_window(camera, (100, 150), "whole")) == (0, 0, 1001, 1500)


def test_another_aspect_is_refused_for_the_whole_photograph():
    with pytest.raises(PreparationError, match=r"512x512 has another aspect .*4096x6144.*center or box"):
        framing_window(STUDIO, (512, 512), "whole")


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 300), st.integers(1, 300), st.integers(300, 3000), st.integers(300, 3000))
def test_the_centred_window_is_the_largest_of_its_aspect(width, height, across, down):
    camera = Camera("PINHOLE", across, down, [1000, 1000, 1, 1])
    window = framing_window(camera, (width, height), "center")
    assert np.isclose(window.width / window.height, width / height, rtol=1e-12)
    assert np.isclose(window.x + window.width / 2, across / 2)
    assert np.isclose(window.y + window.height / 2, down / 2)
    assert np.isclose(max(window.width / across, window.height / down), 1, rtol=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.1, 0.1), st.floats(0.9, 1.1)),
    st.floats(0.01, 0.05),
    st.sampled_from([(64, 96), (96, 64), (50, 50)]),
)
def test_a_window_around_a_box_has_the_aspect_lies_inside_and_holds_the_box(center, half, size):
    corners = box_corners(center, half)
    window = framing_window(STUDIO, size, "box", corners)
    assert np.isclose(window.width / window.height, size[0] / size[1], rtol=1e-12)
    assert window.x >= 0
    assert window.y >= 0
    assert window.x + window.width <= 4096 + 1e-6
    assert window.y + window.height <= 6144 + 1e-6
    pixels, valid = STUDIO.project(corners)
    low, high = np.maximum(pixels.min(0), 0), np.minimum(pixels.max(0), (4096, 6144))
    fits = ((high - low) / size).max() <= min(4096 / size[0], 6144 / size[1])
    assert valid.all()
    if fits:
        assert (low >= np.array([window.x, window.y]) - 1e-6).all()
        assert (high <= np.array([window.x + window.width, window.y + window.height]) + 1e-6).all()
        tight = max((high - low) / np.array([window.width, window.height]))
        assert tight > 0.98  # no larger than the box asks for; its edges bow past its corners a little


def test_a_box_larger_than_the_picture_gets_the_largest_window():
    window = framing_window(STUDIO, (512, 512), "box", box_corners((0, 0, 1), 0.5))
    assert np.isclose(window.width, 4096)
    assert np.isclose(window.height, 4096)


def test_a_small_far_box_is_not_enlarged():
    window = framing_window(STUDIO, (512, 768), "box", box_corners((0, 0, 1), 1e-4))
    assert (window.width, window.height) == (512, 768)


def test_a_box_behind_the_camera_or_out_of_the_picture_is_refused():
    with pytest.raises(PreparationError, match=r"box: is not wholly before the camera.*alignment"):
        framing_window(STUDIO, (64, 96), "box", box_corners((0, 0, 0), 0.1))
    with pytest.raises(PreparationError, match=r"box: is not in the picture"):
        framing_window(STUDIO, (64, 96), "box", box_corners((3, 0, 1), 0.1))


@pytest.mark.parametrize("size", [(8192, 12288), (4097, 100), (100, 6145)])
@pytest.mark.parametrize("framing", ["whole", "center", "box"])
def test_enlarging_is_refused(size, framing):
    with pytest.raises(PreparationError, match=r"larger than the photograph's 4096x6144; .*--resolution"):
        framing_window(STUDIO, size, framing, box_corners((0, 0, 1), 0.1))


@pytest.mark.parametrize("size", [(0, 768), (512, -1), (512.5, 768)])
def test_a_size_that_is_none_is_refused(size):
    with pytest.raises(PreparationError, match=r"resolution: .* is no size"):
        framing_window(STUDIO, size, "whole")


@pytest.mark.parametrize(
    "window",
    [
        Window(-1, 0, 512, 768),
        Window(3600, 0, 512, 768),
        Window(0, 0, np.nan, 768),
        Window(0, 5500, 512, 768),
    ],
)
def test_a_window_that_reaches_out_of_the_image_is_refused(window):
    with pytest.raises(PreparationError, match=r"window: .*reaches out of the 4096x6144 image"):
        Resampler(STUDIO, (512, 768), window)


def test_a_window_smaller_than_the_result_is_refused():
    with pytest.raises(PreparationError, match=r"window: 511x768 pixels would be enlarged to 512x768"):
        Resampler(STUDIO, (512, 768), Window(0, 0, 511, 768))


# -------------------------------------------------------------------------------------- cameras


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(LENSES),
    st.tuples(st.floats(0, 0.5), st.floats(0, 0.5), st.floats(0.4, 1), st.floats(0.4, 1)),
    st.tuples(st.integers(1, 40), st.integers(1, 40)),
)
def test_the_camera_of_a_window_sees_every_point_where_the_resampled_image_shows_it(lens, part, size):
    camera = Camera(lens[0], 400, 300, lens[1])
    x, y = part[0] * 400, part[1] * 300
    window = Window(x, y, part[2] * (400 - x), part[3] * (300 - y))
    if window.width < size[0] or window.height < size[1]:
        return
    result = camera_of_window(camera, size, window)
    points = np.random.default_rng(0).uniform((-0.2, -0.15, 0.9), (0.2, 0.15, 1.1), (50, 3))
    original, valid = camera.project(points)
    shown, still_valid = result.project(points)
    scale = np.array(size) / (window.width, window.height)
    np.testing.assert_allclose(shown, (original - (window.x, window.y)) * scale, atol=1e-9)
    np.testing.assert_array_equal(valid, still_valid)
    assert (result.width, result.height) == size


@pytest.mark.parametrize("undistort", ["keep", "resample"])
@pytest.mark.parametrize("framing", ["whole", "center", "box"])
def test_rays_of_results_meet_the_photograph_where_their_pixels_came_from(undistort, framing):
    size = (512, 768) if framing == "whole" else (480, 640)
    window = framing_window(STUDIO, size, framing, box_corners((0.02, 0.01, 1), 0.08))
    result = Resampler(STUDIO, size, window, PreparationOptions(undistort=undistort)).camera
    pixels = np.random.default_rng(1).uniform(0, size, (1000, 2))
    rays, valid = result.unproject(pixels)
    seen, _ = STUDIO.project(np.c_[rays, np.ones(len(rays))])
    assert valid.all()
    corner, scale = (window.x, window.y), np.array([window.width, window.height]) / size
    if undistort == "keep":
        np.testing.assert_allclose(seen, pixels * scale + corner, atol=1e-8)
    else:  # the same direction through a camera without distortion
        pinhole = Camera("PINHOLE", 4096, 6144, STUDIO.params[:4])
        straight, _ = pinhole.project(np.c_[rays, np.ones(len(rays))])
        np.testing.assert_allclose(straight, pixels * scale + corner, atol=1e-8)
