"""Rays lead back to their pixels, have multinerf's radii, and are the same in torch."""

import numpy as np
import pytest
import torch

from preface.geometry import Camera, Rays, Rigid, Views, cast_rays, nearest_rotation, pixel_centers

CAMERAS = [
    Camera("PINHOLE", 64, 96, [150.0, 152, 30, 50]),
    Camera("SIMPLE_RADIAL", 64, 96, [150.0, 30, 50, -0.2]),
    Camera("OPENCV", 64, 96, [150.0, 152, 30, 50, -0.2, 0.1, 2e-3, -3e-3]),
]


def poses(count: int = 3) -> list[Rigid]:
    """World-from-camera, at a metre or so."""
    rng = np.random.default_rng(4)
    return [Rigid(nearest_rotation(rng.normal(size=(3, 3))), rng.normal(size=3)) for _ in range(count)]


VIEWS = Views.stack(CAMERAS, poses())


def test_pixel_centres_start_at_half_a_pixel() -> None:
    centers = pixel_centers(3, 2)
    assert centers.shape == (2, 3, 2)
    assert centers[0, 0].tolist() == [0.5, 0.5]
    assert centers[1, 2].tolist() == [2.5, 1.5]


@pytest.mark.parametrize("i", range(3))
def test_every_point_of_a_ray_projects_to_its_pixel_at_the_depth_of_its_parameter(i: int) -> None:
    pixels = pixel_centers(64, 96)
    rays = cast_rays(VIEWS[i], pixels)
    assert rays.origins.shape == rays.directions.shape == (96, 64, 3)
    assert rays.radii.shape == (96, 64, 1)
    assert rays.valid.all()
    for t in (0.1, 1.0, 30.0):
        in_camera = poses()[i].inverse.apply(rays.origins + t * rays.directions)
        np.testing.assert_allclose(in_camera[..., 2], t, rtol=1e-12)
        np.testing.assert_allclose(CAMERAS[i].project(in_camera)[0], pixels, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(rays.viewdirs, axis=-1), 1, rtol=1e-14)
    np.testing.assert_allclose(np.cross(rays.viewdirs, rays.directions), 0, atol=1e-14)


@pytest.mark.parametrize(("i", "tolerance"), [(0, 1e-10), (1, 5e-3), (2, 5e-3)])
def test_radii_are_the_mean_step_to_the_next_pixels_as_multinerf_defines_them(
    i: int, tolerance: float
) -> None:
    """Exactly for a pinhole; to the half pixel by which multinerf's difference is off centre otherwise."""
    pixels = pixel_centers(64, 96)
    here, right, below = (cast_rays(VIEWS[i], pixels + step) for step in ((0, 0), (1, 0), (0, 1)))
    steps = [np.linalg.norm(there.directions - here.directions, axis=-1) for there in (right, below)]
    np.testing.assert_allclose(
        here.radii[..., 0], (steps[0] + steps[1]) / 2 * 2 / np.sqrt(12), rtol=tolerance
    )


@pytest.mark.parametrize("i", [1, 2])
def test_radii_are_those_of_steps_centred_on_the_pixel(i: int) -> None:
    pixels, h = pixel_centers(64, 96), 1e-3
    steps = []
    for axis in np.eye(2):
        ahead, behind = (cast_rays(VIEWS[i], pixels + sign * h * axis).directions for sign in (1, -1))
        steps.append(np.linalg.norm(ahead - behind, axis=-1) / (2 * h))
    radii = cast_rays(VIEWS[i], pixels).radii[..., 0]
    np.testing.assert_allclose(radii, (steps[0] + steps[1]) / np.sqrt(12), rtol=1e-8)


def assert_same_rays(found: Rays, expected: Rays, tolerance: float) -> None:
    for name in ("origins", "directions", "viewdirs", "radii"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=tolerance, atol=tolerance, err_msg=name
        )
    np.testing.assert_array_equal(found.valid, expected.valid)


def test_a_flat_batch_gathers_a_camera_per_ray() -> None:
    rng = np.random.default_rng(0)
    index, pixels = rng.integers(0, 3, 50), rng.uniform((0, 0), (64, 96), (50, 2))
    batch = cast_rays(VIEWS[index], pixels)
    for i in range(3):
        chosen = Rays(*(getattr(batch, name)[index == i] for name in Rays.__dataclass_fields__))
        assert_same_rays(chosen, cast_rays(VIEWS[i], pixels[index == i]), 1e-15)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
def test_torch_runs_the_same_formulas(dtype: torch.dtype, tolerance: float) -> None:
    rng = np.random.default_rng(0)
    index, pixels = rng.integers(0, 3, 500), rng.integers((0, 0), (64, 96), (500, 2)) + 0.5
    views = VIEWS.map(lambda array: torch.tensor(array, dtype=dtype))
    rays = cast_rays(views[torch.tensor(index)], torch.tensor(pixels, dtype=dtype))
    assert {getattr(rays, name).dtype for name in ("origins", "directions", "viewdirs", "radii")} == {dtype}
    assert_same_rays(rays, cast_rays(VIEWS[index], pixels), tolerance)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_an_accelerator_gives_the_same_rays() -> None:
    rng = np.random.default_rng(0)
    index, pixels = rng.integers(0, 3, 5000), rng.integers((0, 0), (64, 96), (5000, 2)) + 0.5
    views = VIEWS.map(lambda array: torch.tensor(array, dtype=torch.float32, device="cuda"))
    rays = cast_rays(views[torch.tensor(index, device="cuda")], torch.tensor(pixels, device="cuda").float())
    on_cpu = Rays(*(getattr(rays, name).cpu() for name in Rays.__dataclass_fields__))
    assert_same_rays(on_cpu, cast_rays(VIEWS[index], pixels), 1e-6)


def test_pixels_beyond_the_fold_have_no_ray() -> None:
    folding = Camera("SIMPLE_RADIAL", 64, 96, [60.0, 32, 48, -0.5])
    rays = cast_rays(Views.stack([folding], poses(1))[0], pixel_centers(64, 96))
    assert 0 < rays.valid.sum() < rays.valid.size
    for values in (rays.directions, rays.viewdirs, rays.radii):
        np.testing.assert_array_equal(np.isnan(values).any(axis=-1), ~rays.valid)


def test_every_camera_needs_a_pose() -> None:
    with pytest.raises(ValueError, match="shorter"):
        Views.stack(CAMERAS, poses(2))
