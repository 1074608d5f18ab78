"""MediaPipe's segmentation on what it must survive, and the guided filter that refines it.

How well the network knows people is measured by tools/bench/foreground_masks.py, on photographs that are not ours to
ship.
"""

import numpy as np
import pytest

from preface.capture.foreground import Hints, make_segmenter
from preface.capture.foreground.guided import guided_coefficients, refine
from preface.capture.foreground.light import Light


@pytest.fixture(scope="module")
def selfie():
    return make_segmenter("selfie")


def test_an_empty_wall_has_nobody_on_it(selfie):
    found = selfie(np.full((120, 90, 3), 127, np.uint8), Hints())
    assert found.alpha.max() == 0
    assert "no person" in found.notes[0]


@pytest.mark.parametrize("shape", [(1, 1, 3), (3, 200, 1), (40, 30, 4)])
def test_images_of_any_size_and_kind_are_taken(selfie, shape):
    found = selfie(np.zeros(shape, np.uint16), Hints())
    assert found.alpha.shape == shape[:2]
    assert np.isfinite(found.alpha).all()


def test_guided_coefficients_are_those_of_least_squares_in_every_window():
    rng = np.random.default_rng(0)
    guide, target = rng.random((9, 8, 3), np.float32), rng.random((9, 8), np.float32)
    radius, epsilon = 1, 1e-2
    slopes, offsets = np.zeros((9, 8, 3)), np.zeros((9, 8))
    pad = [(radius, radius), (radius, radius)]
    wide, goal = np.pad(guide, [*pad, (0, 0)], "reflect"), np.pad(target, pad, "reflect")
    for y in range(9):
        for x in range(8):
            window = wide[y : y + 3, x : x + 3].reshape(-1, 3).astype(np.float64)
            values = goal[y : y + 3, x : x + 3].ravel()
            centred = window - window.mean(0)
            slopes[y, x] = np.linalg.solve(
                centred.T @ centred / 9 + epsilon * np.eye(3), centred.T @ (values - values.mean()) / 9
            )
            offsets[y, x] = values.mean() - slopes[y, x] @ window.mean(0)
    slope, offset = guided_coefficients(guide, target, radius, epsilon)
    inner = np.s_[2:7, 2:6]  # the border's averages reflect averages, not windows
    mean = np.stack(
        [[slopes[y - 1 : y + 2, x - 1 : x + 2].mean((0, 1)) for x in range(1, 7)] for y in range(1, 8)]
    )
    np.testing.assert_allclose(slope[inner], mean[1:6, 1:5], atol=1e-3)
    assert offset.shape == (9, 8)


def test_a_blurred_mask_is_brought_to_the_photographs_edge():
    pixels = np.full((600, 2100, 3), 40, np.uint8)
    pixels[:, 1000:] = 190
    light = Light(pixels)
    edge = np.linspace(0, 1, 41)
    coarse = np.zeros((200, 700), np.float32)
    coarse[:, 313:354], coarse[:, 354:] = edge, 1
    alpha = refine(light, coarse, 24, 1e-4)
    assert alpha[:, :995].max() < 0.35
    assert alpha[:, 1005:].min() > 0.65
    assert abs(int((alpha[300] >= 0.5).argmax()) - 1000) <= 1
