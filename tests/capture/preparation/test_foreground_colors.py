"""Colours at the edges of a mask are the foreground's alone, whatever the screen behind it."""

import numpy as np
import pytest

from preface.capture.preparation import PreparationOptions, Resampler, Window
from preface.geometry import Camera

PLAIN = Camera("PINHOLE", 60, 80, [100, 100, 30, 40])
BARREL = Camera("OPENCV", 60, 80, [100, 100, 30, 40, -0.2, 0.05, 0, 0])
SKIN, SCREEN = np.array([190, 140, 120]), np.array([20, 200, 40])


def disc():
    """1 inside a disc, 0 outside, a soft rim of three pixels."""
    y, x = np.mgrid[:80, :60] + 0.5
    return np.clip((20 - np.hypot(x - 31, y - 38)) / 3 + 0.5, 0, 1).astype(np.float32)


def planned(camera, **options):
    return Resampler(camera, (15, 20), Window(0, 0, 60, 80), PreparationOptions(**options))


@pytest.mark.parametrize("camera", [PLAIN, BARREL])
@pytest.mark.parametrize("light", ["linear", "encoded"])
def test_a_screen_leaves_no_trace_in_pixels_that_show_any_foreground(camera, light):
    alpha = (disc() > 0.5).astype(np.uint8) * 255
    pixels = np.where(alpha[..., None] > 0, SKIN, SCREEN).astype(np.uint8)
    undistort = "resample" if camera is BARREL else "auto"
    colors, coverage = planned(camera, light=light, undistort=undistort).foreground(pixels, alpha)
    shown = coverage > 2
    assert ((coverage > 2) & (coverage < 253)).sum() > 20
    assert np.abs(colors[shown].astype(int) - SKIN).max() <= 1
    assert np.abs(colors[coverage == 0].astype(int) - SCREEN).max() <= 1


MASKS = {
    "bytes": lambda rng: rng.integers(0, 256, (80, 60), np.uint8),
    "shares": lambda rng: rng.uniform(0, 1, (80, 60)).astype(np.float32),
    # Most of them are less than half a byte, and count all the same.
    "faint shares": lambda rng: rng.uniform(0, 0.004, (80, 60, 1)).astype(np.float32),
}


@pytest.mark.parametrize("mask", MASKS)
def test_the_mean_is_weighted_by_alpha(mask):
    rng = np.random.default_rng(1)
    pixels, alpha = rng.integers(0, 256, (80, 60, 3), np.uint8), MASKS[mask](rng)
    colors, coverage = planned(PLAIN, light="encoded").foreground(pixels, alpha)
    weights = alpha.reshape(20, 4, 15, 4).astype(np.float64) / (255 if alpha.dtype == np.uint8 else 1)
    values = pixels.reshape(20, 4, 15, 4, 3).astype(np.float64)
    wanted = np.einsum("iajb,iajbc->ijc", weights, values) / weights.sum(axis=(1, 3))[..., None]
    shown = coverage > 0
    assert shown.sum() > 50
    assert np.abs(colors - wanted)[shown].max() <= 0.5 + 1e-3
    assert np.abs(coverage - 255 * weights.mean(axis=(1, 3))).max() <= 0.5 + 1e-3


@pytest.mark.parametrize("dtype", [np.uint16, np.float16, np.float32])
@pytest.mark.parametrize("filter", ["area", "lanczos", "bilinear"])
def test_every_type_and_filter_agrees_with_bytes(dtype, filter):
    alpha = disc()
    most = np.iinfo(dtype).max if np.dtype(dtype).kind == "u" else 1
    pixels = np.zeros((80, 60, 3), dtype)
    pixels[...] = np.where(alpha[..., None] > 0, 0.5, 0.25) * most
    options = {"filter": filter, "light": "encoded"} if most > 1 else {"filter": filter}
    colors, coverage = planned(PLAIN, **options).foreground(pixels, alpha)
    seen = coverage > 10
    wanted = 127.5 if most > 1 else 187.5
    assert np.abs(colors[seen] - wanted).max() <= 1


def test_grey_photographs_and_whole_masks_are_taken_as_they_are():
    grey = np.random.default_rng(2).integers(0, 256, (80, 60, 1), np.uint8)
    plan = planned(PLAIN)
    for level in (0, 255):
        colors, coverage = plan.foreground(grey, np.full((80, 60), level, np.uint8))
        np.testing.assert_array_equal(colors, plan.colors(grey))
        assert (coverage == level).all()
    colors, _ = plan.foreground(grey, (disc() > 0.5).astype(np.float32))
    assert colors.shape == (20, 15, 3)
    assert (colors[..., 0] == colors[..., 2]).all()
