"""Resampling distortion away, held against pictures whose light is a known function of direction."""

import numpy as np
import pytest

from preface.capture.preparation import (
    PreparationError,
    PreparationOptions,
    Resampler,
    Window,
    framing_window,
)
from preface.capture.preparation.places import Places
from preface.geometry import Camera, pixel_centers

SIZE = (400, 300)
BARREL = Camera("OPENCV", *SIZE, [350, 345, 199, 152, -0.2, 0.03, 1e-3, -2e-3])
PINCUSHION = Camera("OPENCV", *SIZE, [350, 345, 199, 152, 0.2, 0.03, 1e-3, -2e-3])
RATIONAL = Camera("FULL_OPENCV", *SIZE, [350, 345, 199, 152, -0.1, 0.03, 1e-3, -2e-3, 0.01, 0.05, 0.02, 0.01])
FOLDING = Camera("SIMPLE_RADIAL", *SIZE, [350, 200, 150, -0.8])
LENSES = {"barrel": BARREL, "pincushion": PINCUSHION, "rational": RATIONAL}


def light_from(directions):
    """A smooth picture on the plane at depth 1, [..., 3] in [0, 1]."""
    x, y = directions[..., 0], directions[..., 1]
    waves = [np.sin(9 * x + 4 * y), np.cos(7 * y - 3 * x), np.sin(12 * x * y + 5 * y)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def photograph(camera, dtype=np.float32):
    directions, valid = camera.unproject(pixel_centers(camera.width, camera.height))
    light = np.where(valid[..., None], light_from(directions), 0.5)
    if dtype == np.float32:
        return light.astype(np.float32)
    return np.rint(255 * srgb(light)).astype(np.uint8)


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def shown_by(camera):
    """What a pinhole shows, and whether it lies in the photograph, per result pixel, at 4x4 points of each."""
    across, down = np.arange(camera.width * 4) / 4 + 1 / 8, np.arange(camera.height * 4) / 4 + 1 / 8
    grid = np.stack(np.meshgrid(across, down), -1)
    return camera.unproject(grid)[0]


def by_pixel(values):
    height, width = values.shape[0] // 4, values.shape[1] // 4
    return values.reshape(height, 4, width, 4, -1).mean((1, 3))


@pytest.mark.parametrize("filter", ["area", "lanczos", "bilinear"])
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("barrel", (40, 30)),
        ("pincushion", (40, 30)),
        ("rational", (40, 30)),
        ("barrel", (160, 120)),
        ("barrel", (280, 210)),
    ],
)
def test_a_pinhole_result_shows_every_direction_where_its_camera_says(name, filter, size):
    camera = LENSES[name]
    options = PreparationOptions(filter=filter, undistort="resample")
    plan = Resampler(camera, size, framing_window(camera, size, "whole"), options)
    assert plan.camera.model == "PINHOLE"
    directions = shown_by(plan.camera)
    wanted = 255 * srgb(by_pixel(light_from(directions)))
    covered = plan.coverage(np.ones((300, 400), np.float32)) == 255
    found = plan.colors(photograph(camera))
    # Bytes are rounded; the kernels differ from the mean of 4x4 points by their own blur.
    assert np.abs(found - wanted)[covered].max() < 2.5
    assert np.abs(found - wanted)[covered].mean() < 0.4
    assert covered.mean() > 0.7


def test_a_shift_of_a_tenth_of_a_source_pixel_would_be_noticed():
    """The error above, as a displacement: the result is matched to its own shifted copies."""
    plan = Resampler(
        BARREL,
        (100, 75),
        framing_window(BARREL, (100, 75), "whole"),
        PreparationOptions(undistort="resample"),
    )
    found = plan.colors(photograph(BARREL)).astype(np.float64)
    error = {}
    for axis in (0, 1):
        for shift in (-0.01, 0.0, 0.01):  # of a result pixel: 0.04 of the source's
            moved = plan.camera.params.copy()
            moved[2 + axis] += shift
            camera = Camera("PINHOLE", 100, 75, moved)
            error[axis, shift] = np.mean((255 * srgb(by_pixel(light_from(shown_by(camera)))) - found) ** 2)
        # The parabola through three errors has its minimum at the displacement.
        low, mid, high = (error[axis, shift] for shift in (-0.01, 0.0, 0.01))
        displacement = 0.005 * (low - high) / (low - 2 * mid + high)
        assert abs(displacement) < 0.0025  # 0.01 source pixels


def test_where_the_pinhole_looks_past_the_photograph_nothing_is_covered():
    plan = Resampler(PINCUSHION, (100, 75), Window(0, 0, 400, 300), PreparationOptions(undistort="resample"))
    pixels, valid = PINCUSHION.project(
        np.concatenate([shown_by(plan.camera), np.ones((300, 400, 1))], axis=-1)
    )
    inside = valid & (pixels >= 0).all(-1) & (pixels <= SIZE).all(-1)
    wanted = by_pixel(inside.astype(float))[..., 0]
    coverage = plan.coverage(np.ones((300, 400), np.float32))
    assert np.abs(coverage / 255 - wanted).max() < 0.3
    assert np.abs(coverage / 255 - wanted).mean() < 1e-2
    assert (coverage[wanted == 0] == 0).mean() > 0.99
    colours = plan.colors(np.full((300, 400, 3), 200, np.uint8))
    assert (colours[coverage == 0] == 0).all()
    assert (colours[coverage > 1] == 200).all()  # not darkened where they are covered in part
    assert (coverage == 0).any()


def test_a_lens_that_folds_inside_the_window_is_resampled_or_refused():
    window = Window(0, 0, 400, 300)
    with pytest.raises(
        PreparationError, match=r"undistort: keep: the lens folds .*; choose auto or resample"
    ):
        Resampler(FOLDING, (100, 75), window, PreparationOptions(undistort="keep"))
    plan = Resampler(FOLDING, (100, 75), window)
    assert plan.undistorted
    assert not plan.camera.folds_inside_image()
    radius = np.hypot(*np.moveaxis(shown_by(plan.camera), -1, 0))
    beyond = by_pixel((radius >= FOLDING.monotonic_radius).astype(float))[..., 0]
    coverage = plan.coverage(np.ones((300, 400), np.float32))
    assert (beyond == 1).any()
    assert (coverage[beyond == 1] == 0).all()
    assert (coverage[beyond == 0] == 255).mean() > 0.9  # the rest of them looks past the border
    before = coverage == 255
    wanted = 255 * srgb(by_pixel(light_from(shown_by(plan.camera))))
    found = plan.colors(photograph(FOLDING))
    inner = before & (by_pixel(radius[..., None])[..., 0] < 0.7 * FOLDING.monotonic_radius)
    assert np.abs(found - wanted)[inner].max() < 2


def test_a_lens_that_folds_outside_the_window_is_kept():
    plan = Resampler(FOLDING, (50, 38), Window(150, 112, 100, 76))
    assert not plan.undistorted
    assert plan.camera.model == "SIMPLE_RADIAL"


def test_without_distortion_there_is_nothing_to_resample():
    camera = Camera("OPENCV", 64, 48, [100, 100, 32, 24, 0, 0, 0, 0])
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    kept, resampled = (
        Resampler(camera, (16, 12), Window(0, 0, 64, 48), PreparationOptions(undistort=choice))
        for choice in ("keep", "resample")
    )
    np.testing.assert_array_equal(kept.colors(pixels), resampled.colors(pixels))
    assert (kept.camera.model, resampled.camera.model) == ("OPENCV", "PINHOLE")
    np.testing.assert_array_equal(kept.camera.K, resampled.camera.K)


@pytest.mark.parametrize("size", [(400, 300), (399, 299), (401, 167)])
@pytest.mark.parametrize("filter", ["area", "lanczos", "bilinear"])
def test_a_constant_photograph_stays_constant_at_odd_sizes(size, filter):
    camera = Camera("OPENCV", *size, [450, 450, 200, 150, -0.1, 0.02, 0, 0])
    window = Window(3.3, 4.4, size[0] - 10, size[1] - 20.0)
    plan = Resampler(camera, (41, 15), window, PreparationOptions(filter=filter, undistort="resample"))
    assert (plan.colors(np.full((size[1], size[0], 3), 77, np.uint8)) == 77).all()
    assert (plan.coverage(np.full((size[1], size[0]), 1, np.float32)) == 255).all()


def test_one_pixel_results_and_grey_pictures_are_undistorted_too():
    plan = Resampler(BARREL, (1, 1), Window(0, 0, 400, 300), PreparationOptions(undistort="resample"))
    grey = np.full((300, 400), 130, np.uint8)
    np.testing.assert_array_equal(plan.colors(grey), [[[130, 130, 130]]])
    assert plan.coverage(grey)[0, 0] == 130


def test_a_photograph_too_wide_to_remap_is_refused_with_a_way_out():
    camera = Camera("SIMPLE_RADIAL", 70000, 300, [70000, 35000, 1500, -0.01])
    with pytest.raises(PreparationError, match=r"undistort: .*32767; keep the distortion"):
        Resampler(camera, (700, 3), Window(0, 0, 70000, 300), PreparationOptions(undistort="resample"))


# -------------------------------------------------------------------------------------- places


@pytest.mark.parametrize(
    ("lens", "nodes"),
    [
        (BARREL, 8),
        (Camera("FULL_OPENCV", *SIZE, [350, 345, 199, 152, -0.1, 0.03, 1e-3, -2e-3, 0.01, 0, 0, 0]), 8),
        (RATIONAL, 16),
        (
            Camera("FULL_OPENCV", *SIZE, [300, 300, 199, 152, 0.1, 0, 0, 0, 0, -1.9, 0, 0]),
            0,
        ),  # a pole at 0.725
    ],
)
def test_places_are_those_of_the_exact_projection(lens, nodes):
    pinhole = Camera("PINHOLE", 200, 150, [175, 172, 99, 76.5])
    places = Places(lens, pinhole)
    x, y, valid = places.rows(20, 130)
    directions, _ = pinhole.unproject(pixel_centers(200, 150))
    exact, in_disc = lens.project(np.concatenate([directions, np.ones((150, 200, 1))], axis=-1))
    exact, in_disc = exact[20:130], in_disc[20:130]
    inside = in_disc & (exact >= 0).all(-1) & (exact <= SIZE).all(-1)
    assert places.nodes <= nodes or nodes == 0
    assert (nodes == 0) == (places.nodes == 0)
    if valid is None:
        assert inside.all()
        valid = inside
    assert (valid == inside).mean() > 0.9999
    both = valid & inside
    assert np.hypot(x - exact[..., 0], y - exact[..., 1])[both].max() < 1e-3
    assert both.any()
    assert np.isfinite(x).all()
    assert np.isfinite(y).all()
