"""Geometry at the limits: far away, very long lenses, next to folds and poles, and in float32."""

import numpy as np
import pytest
import torch

from preface.geometry import (
    Box,
    Camera,
    Rigid,
    Similarity,
    Views,
    cast_rays,
    fit_similarity,
    nearest_rotation,
)
from preface.geometry import lens as lens_functions

FULL_SIZE = (4096, 6144)
FOLDING = {
    "SIMPLE_RADIAL": [6000.0, 2048, 3072, -1.5],
    "RADIAL": [6000.0, 2048, 3072, -1.0, -1.0],
    "OPENCV": [6000.0, 6060, 2048, 3072, 0.3, -2.0, 2e-3, -3e-3],
    "FULL_OPENCV": [6000.0, 6060, 2048, 3072, -0.5, 0.1, 1e-3, 1e-3, -1.0, 0.4, 0.2, 0.1],
    "pole": [6000.0, 6060, 2048, 3072, 0, 0, 0, 0, 0, -2.0, 0, 0],
}


def camera_of(name: str) -> Camera:
    return Camera("FULL_OPENCV" if name == "pole" else name, *FULL_SIZE, np.array(FOLDING[name]))


def circle(radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 721)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones_like(angle)], axis=-1)


@pytest.mark.parametrize("name", FOLDING)
@pytest.mark.parametrize("share", [0.5, 0.99, 0.9999, 0.999999])
def test_unprojection_holds_up_to_the_edge_of_the_monotonic_range(name: str, share: float) -> None:
    camera = camera_of(name)
    points = circle(share * camera.monotonic_radius)
    pixels, projected = camera.project(points)
    normalised, unprojected = camera.unproject(pixels)
    assert projected.all()
    assert unprojected.all()
    again, _ = camera.project(np.concatenate([normalised, points[:, 2:]], axis=-1))
    # Pixels near the pole are large: there, a rounding of the direction is all that can be asked for.
    np.testing.assert_allclose(again, pixels, rtol=1e-14 / (1 - share) if name == "pole" else 0, atol=1e-10)
    np.testing.assert_allclose(normalised, points[:, :2], rtol=0, atol=1e-13 / (1 - share))


@pytest.mark.parametrize("name", FOLDING)
@pytest.mark.parametrize("share", [1 + 1e-9, 1.0001, 1.5, 10])
def test_points_past_the_monotonic_radius_are_masked(name: str, share: float) -> None:
    camera = camera_of(name)
    pixels, valid = camera.project(circle(share * camera.monotonic_radius))
    assert not valid.any()
    assert np.isnan(pixels).all()


@pytest.mark.parametrize("name", ["SIMPLE_RADIAL", "RADIAL"])
def test_pixels_past_the_fold_are_masked_and_those_before_it_are_not(name: str) -> None:
    camera = camera_of(name)
    edge = lens_functions.distort(camera.intrinsics, camera.monotonic_radius, 0.0).x
    center = camera.K[:2, 2]
    ring = camera.K[0, 0] * edge * circle(1.0)[:, :2]
    assert camera.unproject(center + (1 - 1e-12) * ring)[1].all()
    for share in (1 + 1e-9, 1.001, 2, 1e6):
        normalised, valid = camera.unproject(center + share * ring)
        assert not valid.any()
        assert np.isnan(normalised).all()


def test_a_lens_of_a_hundred_thousand_pixels_keeps_its_round_trip() -> None:
    camera = Camera("OPENCV", *FULL_SIZE, [1e5, 1e5, 2048, 3072, -30.0, 500, 1e-3, 1e-3])
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, FULL_SIZE, (1000, 2))
    normalised, valid = camera.unproject(pixels)
    assert valid.all()
    again, _ = camera.project(np.concatenate([normalised, np.ones((1000, 1))], axis=-1))
    np.testing.assert_allclose(again, pixels, rtol=0, atol=1e-10)


def test_depth_from_nanometres_to_a_million_metres_does_not_matter() -> None:
    camera = camera_of("OPENCV")
    reference, _ = camera.project([0.1, -0.2, 1.0])
    for depth in (1e-9, 1e-3, 1e3, 1e6, 1e12):
        pixels, valid = camera.project(depth * np.array([0.1, -0.2, 1.0]))
        assert valid
        np.testing.assert_allclose(pixels, reference, rtol=1e-13)


def test_directions_across_the_optical_axis_are_masked_or_finite() -> None:
    pinhole = Camera("PINHOLE", *FULL_SIZE, [1e4, 1e4, 2048, 3072])
    for camera in (pinhole, camera_of("OPENCV")):
        for z in (0.0, -0.0, 5e-324, 1e-300, 1e-9, np.nan):
            pixels, valid = camera.project([1.0, 1.0, z])
            assert bool(np.isfinite(pixels).all()) == bool(valid)


@pytest.mark.parametrize("pixel", [(np.nan, 0), (np.inf, 0), (1e300, -1e300), (1e30, 0)])
def test_absurd_pixels_are_masked_or_right(pixel: tuple[float, float]) -> None:
    for name in ("SIMPLE_RADIAL", "OPENCV"):
        normalised, valid = camera_of(name).unproject(np.array(pixel))
        assert not valid
        assert np.isnan(normalised).all()


def test_the_principal_point_looks_straight_ahead_even_in_float32() -> None:
    for name in FOLDING:
        camera = camera_of(name)
        for dtype in (torch.float32, torch.float64):
            normalised, valid = camera.unproject(torch.tensor([2048.0, 3072.0], dtype=dtype))
            assert valid
            assert normalised.tolist() == [0, 0]


def test_tiny_and_huge_distortion_coefficients_have_their_radius() -> None:
    for exponent in range(-300, 301, 20):
        camera = Camera("SIMPLE_RADIAL", 64, 96, [100.0, 32, 48, -(10.0**exponent)])
        assert camera.monotonic_radius == pytest.approx((3 * 10.0**exponent) ** -0.5, rel=1e-12)


@pytest.mark.parametrize("focal", [4000.0, 13500, 40000])
@pytest.mark.parametrize("bend", [-0.15, 0.15])
def test_float32_rays_stay_within_a_hundredth_of_a_pixel_at_24_megapixels(focal: float, bend: float) -> None:
    corner = np.hypot(*FULL_SIZE) / 2 / focal
    distortion = [bend / corner**2, -bend / 5 / corner**4, 1e-3 / corner, -1e-3 / corner]
    camera = Camera("OPENCV", *FULL_SIZE, [focal, 1.01 * focal, 2051.37, 3068.91, *distortion])
    pose = Rigid(nearest_rotation(np.random.default_rng(0).normal(size=(3, 3))), np.ones(3))
    x, y = np.append(np.arange(0.5, 4096, 64), 4095.5), np.append(np.arange(0.5, 6144, 64), 6143.5)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    views = Views.stack([camera], [pose])
    single = views.map(lambda array: torch.tensor(array, dtype=torch.float32))
    rays = cast_rays(single[0], torch.tensor(pixels, dtype=torch.float32))
    assert rays.valid.all()
    hit, _ = camera.project(rays.directions.double().numpy() @ pose.rotation)
    aimed, _ = camera.project(cast_rays(views[0], pixels).directions @ pose.rotation)
    assert np.linalg.norm(hit - aimed, axis=-1).max() < 0.01


def test_float32_next_to_the_fold_is_masked_or_right() -> None:
    camera = camera_of("SIMPLE_RADIAL")
    for share in (0.9, 0.99, 0.999, 0.9999, 1.0, 1.001):
        edge = share * lens_functions.distort(camera.intrinsics, camera.monotonic_radius, 0.0).x
        pixels = torch.tensor(
            camera.K[:2, 2] + camera.K[0, 0] * edge * circle(1.0)[:, :2], dtype=torch.float32
        )
        normalised, valid = camera.unproject(pixels)
        assert valid.all() if share <= 0.9999 else not (share > 1 and valid.any())
        again, _ = camera.project(torch.cat([normalised, torch.ones(721, 1)], dim=-1))
        np.testing.assert_allclose(again[valid], pixels[valid], rtol=0, atol=0.01)


def test_a_face_a_million_metres_away_is_aligned_to_the_rounding_of_its_coordinates() -> None:
    rng = np.random.default_rng(0)
    source = 0.1 * rng.normal(size=(5, 3)) + 1e6
    truth = Similarity(1.3, nearest_rotation(rng.normal(size=(3, 3))), np.array([-1e6, 2e6, 3e6]))
    fit = fit_similarity(source, truth.apply(source))
    rounding = np.spacing(4e6)
    assert fit.rms < 2 * rounding
    assert fit.target_from_source.scale == pytest.approx(1.3, abs=100 * rounding)
    np.testing.assert_allclose(fit.target_from_source.rotation, truth.rotation, atol=100 * rounding)
    np.testing.assert_allclose(fit.target_from_source.apply(source), truth.apply(source), atol=4 * rounding)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1e9])
def test_similarity_does_not_care_for_the_size_of_things(size: float) -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(5, 3))
    fit = fit_similarity(size * source, source)
    assert fit.target_from_source.scale == pytest.approx(1 / size, rel=1e-12)
    np.testing.assert_allclose(fit.target_from_source.rotation, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_box_directions_may_have_components_of_any_size(dtype: torch.dtype) -> None:
    box = Box([-1, -1, -1], [1, 1, 1])
    tiny = torch.finfo(dtype).tiny
    directions = torch.tensor([[tiny, 0.0, 1], [0.0, -tiny, 1], [0.0, 0, tiny], [0, 0, 1e30]], dtype=dtype)
    origins = torch.tensor([[0.0, 0, -5]] * 4, dtype=dtype)
    near, far, hit = box.intersect(origins, directions)
    assert hit[[0, 1, 3]].all()
    torch.testing.assert_close(near[:2], torch.full((2,), 4.0, dtype=dtype))
    torch.testing.assert_close(far[:2], torch.full((2,), 6.0, dtype=dtype))
    assert bool(torch.isfinite(near[2])) == bool(hit[2])


def test_a_box_a_million_metres_away_is_hit_where_it_is() -> None:
    box = Box([1e6 - 1, -1, -1], [1e6 + 1, 1, 1])
    near, far, hit = box.intersect(np.zeros((2, 3)), [[1.0, 0, 0], [1.0, 1e-5, 0]])
    assert hit.tolist() == [True, False]
    assert (near[0], far[0]) == (1e6 - 1, 1e6 + 1)
