"""What is behind the people."""

from pathlib import Path

import numpy as np
import pytest

from synthetic_studio.backgrounds import backdrop, background_radiance, composite
from synthetic_studio.config import StudioConfig
from synthetic_studio.rig import nominal_rig

CAMERA = nominal_rig(1, (64, 96), 0)[0].camera


@pytest.mark.parametrize(("takes", "expected"), [(1, "b"), (2, "bg"), (3, "bbg"), (4, "bbgg")])
def test_a_lab_that_changes_has_black_first_and_green_later(takes, expected):
    config = StudioConfig(Path("x"), takes=takes)
    assert "".join(backdrop(config, take)[0] for take in range(takes)) == expected


@pytest.mark.parametrize("kind", ["black", "green"])
def test_a_lab_that_does_not_change_keeps_its_backdrop(kind):
    config = StudioConfig(Path("x"), takes=3, background=kind)
    assert {backdrop(config, take) for take in range(3)} == {kind}


def test_green_screen_is_green_everywhere_and_a_little_uneven():
    screen = background_radiance("green", CAMERA, 0, 1, 0)
    assert (screen[..., 1] > 3 * screen[..., [0, 2]].max(axis=-1)).all()
    assert 1.01 < screen[..., 1].max() / screen[..., 1].min() < 1.7
    assert np.abs(np.diff(screen[..., 1], axis=0)).max() < 0.01


def test_green_screen_differs_between_cameras_and_takes_and_not_otherwise():
    screens = [background_radiance("green", CAMERA, 0, *which) for which in ((1, 0), (1, 1), (2, 0), (1, 0))]
    assert (screens[0] != screens[1]).any()
    assert (screens[0] != screens[2]).any()
    np.testing.assert_array_equal(screens[0], screens[3])


def test_compositing_fills_what_the_subject_leaves_open():
    radiance, alpha = np.full((1, 3, 3), 0.2), np.array([[0.0, 0.5, 1.0]])
    radiance[0, 0] = 0
    seen = composite(radiance, alpha, np.full((1, 3, 3), 0.4))
    np.testing.assert_allclose(seen[0, :, 0], [0.4, 0.4, 0.2])
