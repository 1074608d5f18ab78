"""Black backgrounds and clean plates against drawn people."""

import numpy as np
import pytest
from drawn_person import GREEN, iou, person, photograph, screen

from preface.capture.foreground import ForegroundError, Hints, make_segmenter

DARK = np.array([0.0008, 0.0008, 0.001])


def mask(method, pixels, plate=None):
    return make_segmenter(method)(pixels, Hints(plate=plate))


def patterned(height, width):
    """A room: stripes and a bright window."""
    room = np.full((height, width, 3), (0.2, 0.18, 0.15), np.float32)
    room[:, ::16] = 0.05
    room[20:60, 5:40] = (0.7, 0.75, 0.9)
    return room


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_before_black_the_outline_is_right(dtype):
    alpha, light = person()
    found = mask("black", photograph(alpha, light, screen(240, 160, 0.3, DARK), dtype, 0.001))
    assert iou(found.alpha, alpha) > 0.99
    assert found.alpha[alpha == 0].mean() < 0.01


def test_dark_hair_before_black_belongs_to_the_head():
    alpha, light = person(hair=(0.004, 0.003, 0.003))
    found = mask("black", photograph(alpha, light, screen(240, 160, 0.3, DARK), noise=0.001))
    assert iou(found.alpha, alpha) > 0.98


def test_pupils_and_nostrils_are_no_holes():
    alpha, light = person()
    light = light.copy()
    for x, y in ((66, 105), (94, 105), (76, 130), (84, 130)):
        light[y - 2 : y + 3, x - 2 : x + 3] = 0
    found = mask("black", photograph(alpha, light, screen(240, 160, 0, DARK)))
    assert found.alpha[100:135, 60:100].min() > 0.95


def test_black_folds_of_a_shirt_at_the_bottom_are_no_openings():
    alpha, light = person()
    light = light.copy()
    light[225:, 74:80] = 0
    found = mask("black", photograph(alpha, light, screen(240, 160, 0, DARK)))
    assert found.alpha[228:, 76:79].min() > 0.95


def test_a_reflection_far_from_the_person_is_left_out():
    alpha, light = person()
    background = screen(240, 160, 0, DARK)
    background[20:24, 8:12] = 0.3
    found = mask("black", photograph(alpha, light, background))
    assert found.alpha[15:30, 4:16].max() == 0


def test_nothing_before_black_is_no_foreground():
    found = mask("black", photograph(np.zeros((90, 60)), np.zeros((90, 60, 3)), screen(90, 60, 0.3, DARK)))
    assert found.alpha.max() == 0
    assert "no person" in found.notes[0]


def test_an_image_without_black_is_all_foreground_and_said_so():
    found = mask("black", np.full((60, 40, 3), 180, np.uint8))
    assert found.alpha.min() == 1
    assert "nothing black" in found.notes[0]


@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_a_plate_of_any_room_and_of_another_exposure_serves(gain):
    alpha, light = person()
    room = patterned(240, 160)
    pixels = photograph(alpha, gain * light, gain * room)
    plate = photograph(0 * alpha, light, room, seed=5)
    assert iou(mask("plate", pixels, plate).alpha, alpha) > 0.97


def test_a_shadow_on_the_plate_is_no_person():
    alpha, light = person()
    room = np.full((240, 160, 3), (0.4, 0.38, 0.35), np.float32)
    shaded = room.copy()
    shaded[105:160, 128:155] *= 0.8
    found = mask("plate", photograph(alpha, light, shaded), photograph(0 * alpha, light, room, seed=5))
    assert found.alpha[110:155, 132:150].mean() < 0.05
    assert iou(found.alpha, alpha) > 0.96


def test_a_plate_of_green_or_dark_cloth_serves_too():
    alpha, light = person()
    for colour in (GREEN, DARK):
        behind = screen(240, 160, 0.3, colour)
        found = mask("plate", photograph(alpha, light, behind), photograph(0 * alpha, light, behind, seed=5))
        assert iou(found.alpha, alpha) > 0.97


def test_what_shines_in_the_dark_is_known_from_a_plate():
    alpha, light = person()
    behind = screen(240, 160, 0, DARK)
    behind[150:200, 4:14] = 0.3
    found = mask("black", photograph(alpha, light, behind), photograph(0 * alpha, light, behind, seed=5))
    assert found.alpha[155:195, 6:12].mean() < 0.05
    assert iou(found.alpha, alpha) > 0.98


@pytest.mark.parametrize(
    ("plate", "words"),
    [
        (None, "plate: is missing"),
        (np.zeros((10, 12, 3), np.uint8), "12x10 pixels, and the photograph has 20x30"),
        (np.zeros((30, 20, 3), np.uint16), "uint16"),
    ],
)
def test_a_plate_that_is_missing_or_does_not_fit_is_refused(plate, words):
    with pytest.raises(ForegroundError, match=words):
        mask("plate", np.zeros((30, 20, 3), np.uint8), plate)


@pytest.mark.parametrize("method", ["black", "plate"])
@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 5, 1), (7, 3, 3)])
def test_tiny_and_grey_images_give_coverage_and_no_error(method, shape):
    pixels = np.zeros(shape, np.uint8)
    pixels[shape[0] // 2, shape[1] // 2] = 250
    found = mask(method, pixels, np.zeros(shape, np.uint8))
    assert found.alpha.shape == shape[:2]
    assert np.isfinite(found.alpha).all()


def test_float_images_with_holes_and_overflow_are_segmented():
    alpha, light = person()
    pixels = photograph(alpha, light, screen(240, 160, 0, DARK), np.float32)
    pixels[3, 3], pixels[120, 80] = np.nan, np.inf
    found = mask("black", pixels)
    assert np.isfinite(found.alpha).all()
    assert iou(found.alpha, alpha) > 0.98
