"""Colours of errors and normals, and tiles that are large enough to be looked at."""

import numpy as np
import pytest

from preface.model.rendering.showing import ERROR_SHOWN, error_picture, normals_picture, tile_size


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
