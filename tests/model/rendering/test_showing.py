"""Colours of errors and normals, and tiles that are large enough to be looked at."""

import numpy as np
import pytest

from preface.model.rendering.showing import (
    ERROR_SHOWN,
    depth_entry,
    depth_picture,
    error_entry,
    error_picture,
    normals_entry,
    normals_picture,
    tile_size,
)


def test_errors_grow_brighter_up_to_the_one_that_is_shown_last():
    truth = np.full((1, 4, 3), 0.5)
    rgb = truth + np.array([0.0, 0.5, 1.0, 1.5])[None, :, None] * ERROR_SHOWN * [1, -1, 1]
    brightness = error_picture(rgb, truth).sum(axis=-1, dtype=int)[0]
    assert brightness[0] < brightness[1] < brightness[2] == brightness[3]


def test_axes_of_normals_are_red_green_and_blue_and_none_is_black():
    normals = np.concatenate([np.eye(3), -np.eye(3), np.full((1, 3), np.nan)])[None]
    picture = normals_picture(normals)[0]
    for axis in range(3):
        assert picture[axis, axis] == 255
        assert picture[axis + 3, axis] == 0
        assert set(np.delete(picture[axis], axis)) <= {127, 128}
    assert (picture[6] == 0).all()


def test_legends_have_the_colours_of_the_pictures_from_one_end_to_the_other():
    depths = np.linspace(0.8, 1.2, 160)[None]
    before, bar, after = depth_entry("0.80 m", "1.20 m")
    np.testing.assert_array_equal(bar[0], depth_picture(depths, 0.8, 1.2)[0])
    assert before.endswith("0.80 m")
    assert after.startswith("1.20 m")
    errors = np.linspace(0, ERROR_SHOWN, 160)[None, :, None].repeat(3, 2)
    np.testing.assert_array_equal(error_entry()[1][0], error_picture(errors, np.zeros_like(errors))[0])


def test_the_legend_of_normals_is_a_ball_from_the_front_whose_right_is_the_subjects_left():
    _, ball, words = normals_entry()
    side = len(ball)
    middle, edge = side // 2, 3
    assert words.startswith("red: to the subject's left, green: up, blue: out of the face")
    for row, column, channel in ((middle, side - edge, 0), (edge, middle, 1), (middle, middle, 2)):
        assert ball[row, column].argmax() == channel
    for row, column, channel in ((middle, edge, 0), (side - edge, middle, 1)):
        assert ball[row, column].argmin() == channel
    assert (ball[0, 0] == 0).all()


@pytest.mark.parametrize(
    ("size", "smallest", "tile"),
    [
        ((96, 144), 200, (192, 288)),
        ((300, 200), 200, (300, 200)),
        ((7, 9), 27, (21, 27)),
        ((4, 900), 200, (4, 900)),
    ],
)
def test_tiles_are_whole_multiples_of_their_images_and_not_too_small(size, smallest, tile):
    assert tile_size(*size, smallest) == tile
