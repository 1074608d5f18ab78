"""Green screens: coverage against drawn people, and the screen's light taken out of them."""

import numpy as np
import pytest
from drawn_person import GREEN, iou, person, photograph, screen

from preface.capture.foreground import ForegroundError, Hints, make_segmenter
from preface.srgb import light_of_levels

BLACK = np.zeros(3)


def key(pixels, **hints):
    return make_segmenter("green")(pixels, Hints(**hints))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32])
def test_coverage_is_right_to_a_few_per_cent_in_every_type_of_image(dtype):
    alpha, light = person()
    found = key(photograph(alpha, light, screen(240, 160, 0.2), dtype))
    assert iou(found.alpha, alpha) > 0.99
    mixed = (alpha > 0.05) & (alpha < 0.95)
    assert np.abs(found.alpha - alpha)[mixed].mean() < 0.1
    assert found.alpha.dtype == np.float32
    assert found.pixels.dtype == dtype


@pytest.mark.parametrize("unevenness", [0.0, 0.25, 0.5])
def test_uneven_light_on_the_screen_is_followed(unevenness):
    alpha, light = person()
    found = key(photograph(alpha, light, screen(240, 160, unevenness)))
    assert iou(found.alpha, alpha) > 0.985
    assert found.alpha[alpha == 0].mean() < 0.01


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_noise_leaves_no_specks(noise):
    alpha, light = person()
    found = key(photograph(alpha, light, screen(240, 160, 0.1), noise=noise))
    assert iou(found.alpha, alpha) > 0.98
    far = alpha == 0
    assert (found.alpha[far] > 0.5).mean() < 0.01


def test_a_green_shirt_stays_and_stays_green():
    shirt = (0.03, 0.12, 0.06)
    alpha, light = person(shirt=shirt)
    pixels = photograph(alpha, light, screen(240, 160, 0.1))
    found = key(pixels)
    assert iou(found.alpha, alpha) > 0.985
    inside = np.s_[215:235, 60:100]
    assert np.abs(found.pixels[inside].astype(int) - pixels[inside]).mean() < 2


def test_the_screens_light_on_the_edge_is_taken_out():
    alpha, light = person()
    spilled = light + 0.12 * GREEN * (alpha < 1)[..., None]
    pixels = photograph(alpha, spilled, screen(240, 160, 0.1), noise=0.0005)
    found = key(pixels)

    def greenness(image):
        linear = light_of_levels(np.dtype(np.uint8))[image]
        return (linear[..., 1] - linear[..., [0, 2]].mean(axis=-1))[(alpha > 0.3) & (alpha < 0.95)].mean()

    true = (light[..., 1] - light[..., [0, 2]].mean(axis=-1))[(alpha > 0.3) & (alpha < 0.95)].mean()
    assert greenness(pixels) - true > 0.05
    assert greenness(found.pixels) - true < 0.01


def test_the_screen_itself_is_left_as_it_was():
    alpha, light = person()
    pixels = photograph(alpha, light, screen(240, 160, 0.1))
    found = key(pixels)
    np.testing.assert_array_equal(found.pixels[found.alpha == 0], pixels[found.alpha == 0])


def test_a_gap_between_arm_and_body_shows_the_screen():
    alpha, light = person()
    alpha = alpha.copy()
    alpha[205:220, 70:90] = 0
    found = key(photograph(alpha, light, screen(240, 160, 0.1)))
    assert found.alpha[208:217, 73:87].max() < 0.1


def test_an_empty_screen_has_no_foreground():
    found = key(photograph(np.zeros((120, 80)), np.zeros((120, 80, 3)), screen(120, 80, 0.2)))
    assert found.alpha.max() == 0
    assert found.notes


def test_without_any_green_everything_is_foreground_and_said_so():
    found = key(photograph(np.ones((120, 80)), np.full((120, 80, 3), 0.3), screen(120, 80, 0)))
    assert found.alpha.min() == 1
    assert "no green" in found.notes[0]


def test_a_screen_as_bright_as_the_sensor_can_see():
    alpha, light = person()
    found = key(photograph(alpha, light, screen(240, 160, 0.1, colour=np.array([0.25, 1.6, 0.4]))))
    assert iou(found.alpha, alpha) > 0.98


def test_a_plate_says_where_the_screen_is_although_the_border_does_not():
    alpha, light = person()
    border = screen(240, 160, 0.1)
    border[:20], border[:, :12], border[:, -12:] = 0.2, 0.2, 0.2
    pixels, plate = photograph(alpha, light, border), photograph(alpha * 0, light, border, seed=2)
    found = key(pixels, plate=plate)
    inner = np.s_[24:, 16:-16]
    assert iou(found.alpha[inner], alpha[inner]) > 0.97


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 3, 3), (5, 4, 3), (3, 400, 3)])
def test_tiny_images_give_coverage_and_no_error(shape):
    pixels = np.full(shape, (60, 160, 75), np.uint8)
    pixels[shape[0] // 2, shape[1] // 2] = (200, 150, 140)
    found = key(pixels)
    assert found.alpha.shape == shape[:2]
    assert np.isfinite(found.alpha).all()


def test_grey_images_are_refused():
    with pytest.raises(ForegroundError, match="grey"):
        key(np.zeros((10, 10, 1), np.uint8))
