"""Crops show what lies in their region, and points go back to where they came from."""

import numpy as np
import pytest

from preface.align.crops import Picture, Region, to_image

HEIGHT, WIDTH = 380, 601  # odd, so that halvings do not divide evenly
REGIONS = {
    "upright": Region(np.array([290.0, 200.0]), 200.0),
    "turned": Region(np.array([300.0, 180.0]), 170.0, 0.6),
    "mirrored": Region(np.array([310.0, 190.0]), 180.0, -0.4, mirrored=True),
}


def spot(place):
    """A soft bright spot, 12 pixels wide."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    light = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 12.0**2))
    return np.repeat((250 * light).round().astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("side", [20, 48, 192])
@pytest.mark.parametrize("name", REGIONS)
def test_points_of_the_crop_go_back_to_where_the_image_shows_them(name, side):
    region = REGIONS[name]
    place = region.centre + np.array([17.3, -21.6])
    crop = Picture(spot(place)).crop(region, side)[..., 0].astype(float)
    v, u = np.mgrid[:side, :side] + 0.5
    centroid = np.array([[(crop * u).sum(), (crop * v).sum()]]) / crop.sum()
    np.testing.assert_allclose(to_image(centroid, region, side)[0], place, atol=0.15)


def test_a_strong_reduction_averages_and_does_not_alias():
    stripes = np.zeros((512, 512, 3), np.uint8)
    stripes[:, ::2] = 255
    crop = Picture(stripes).crop(Region(np.array([256.0, 256.0]), 400.0), 40)
    assert abs(crop.astype(float) - 127.5).max() < 3


def test_beyond_the_border_the_last_pixels_go_on():
    image = np.full((50, 50, 3), 10, np.uint8)
    image[:, -1] = 200
    crop = Picture(image).crop(Region(np.array([75.0, 25.0]), 20.0), 20)
    assert (crop == 200).all()


def test_the_region_around_points_is_upright_with_them_and_large_enough():
    turn = 0.7
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    corners = np.array([[-30.0, -50.0], [30.0, -50.0], [30.0, 50.0], [-30.0, 50.0]]) @ rotation.T + [200, 150]
    region = Region.around(corners, turn, 1.5)
    np.testing.assert_allclose(region.centre, [200, 150])
    assert region.side == pytest.approx(150)
    inner = to_image(np.array([[50.0, 50.0], [100.0, 50.0]]), region, 150)
    np.testing.assert_allclose((inner[1] - inner[0]) / 50, rotation[:, 0], atol=1e-12)


def test_depth_is_scaled_with_the_crop():
    points = np.array([[10.0, 10.0, 4.0]])
    assert to_image(points, Region(np.array([100.0, 100.0]), 80.0), 20)[0, 2] == pytest.approx(16)
