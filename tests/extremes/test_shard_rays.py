"""Rays of shards at the extremes: cameras a thousand kilometres away, large images, faces of the box met head-on."""

import numpy as np
import pytest
import torch

from preface.geometry import Camera, Rigid, Views, cast_rays, intersect_box
from preface.shards.batches import form_batch
from preface.shards.compiled import CompiledTable
from preface.shards.rays import RayTable

UNIT = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def by_torch(table, pixels):
    nothing = torch.zeros(1, dtype=torch.int64)
    rgba = torch.zeros(1, len(pixels), dtype=torch.int32)
    return form_batch(table, nothing, nothing, 1, torch.from_numpy(pixels)[None], rgba)


def compiled(table, pixels):
    nothing = np.zeros(1, dtype=np.int64)
    rgba = torch.zeros(1, len(pixels), dtype=torch.int32)
    return CompiledTable(table).form_batch(nothing, nothing, 1, pixels[None], rgba)


@pytest.fixture(params=[by_torch, compiled])
def form(request):
    def form(camera, pose, box, pixels):
        views = Views.stack([camera], [pose])
        near_far, size = np.array([[0.25, 4.0]]), (camera.width, camera.height)
        table = RayTable.build(
            *(views.intrinsics, views.world_from_camera, box[None], near_far, size, 1.0),
            torch.device("cpu"),
        )
        x, y = pixels % camera.width + 0.5, pixels // camera.width + 0.5
        return request.param(table, pixels), cast_rays(views[0], np.stack([x, y], -1))

    return form


def test_depths_from_a_thousand_kilometres_away_are_right_to_a_rounding(form):
    """The differences box - camera are formed before they are rounded: a metre's box at 1e6 m is still met."""
    camera = Camera("PINHOLE", 64, 64, [3.2e7, 3.2e7, 32.0, 32.0])
    pose = Rigid(np.eye(3), np.array([0.0, 0.0, -1e6]))
    batch, expected = form(camera, pose, UNIT, np.arange(64 * 64))
    near, far, hit = intersect_box(*UNIT, expected.origins, expected.directions)
    assert np.array_equal(batch.hit.numpy()[:, 0], hit)
    assert 0.9 < hit.mean() <= 1
    assert np.abs(batch.near.numpy()[hit, 0] / near[hit] - 1).max() < 1.2e-7
    assert np.abs(batch.far.numpy()[hit, 0] / far[hit] - 1).max() < 1.2e-7


def test_a_scene_far_from_the_origin_keeps_its_depths(form):
    """Box and camera at 1e6 m: origins are as exact as float32 can say, depths to a rounding of float64 there."""
    offset = np.array([1e6, -1e6, 1e6])
    camera = Camera("OPENCV", 64, 48, [70.0, 70.0, 32.0, 24.0, -0.1, 0.02, 1e-3, 1e-3])
    batch, expected = form(camera, Rigid(np.eye(3), offset - (0, 0, 5)), UNIT + offset, np.arange(64 * 48))
    near, far, hit = intersect_box(*(UNIT + offset), expected.origins, expected.directions)
    ours = batch.hit.numpy()[:, 0]
    grazing = hit & (far - near < 1e-6)
    assert np.array_equal(ours[~grazing], hit[~grazing])
    both = ours & hit
    assert np.abs(batch.near.numpy()[both, 0] - near[both]).max() < 1e-5
    assert np.abs(batch.far.numpy()[both, 0] - far[both]).max() < 1e-5


@pytest.mark.parametrize("size", [(4096, 4096), (4096, 6144)])
def test_directions_and_radii_at_the_corners_of_large_images(form, size):
    width, height = size
    params = [2.2 * width, 2.2 * width, width / 2, height / 2, -0.1, 0.05, 1e-3, -1e-3]
    rows, columns = np.array([0, 1, height // 2, height - 1]), np.array([0, 1, width // 2, width - 1])
    pixels = (rows[:, None] * width + columns).reshape(-1)
    batch, expected = form(Camera("OPENCV", width, height, params), Rigid.identity(), UNIT, pixels)
    error = np.abs(batch.directions.numpy() - expected.directions).max(axis=0)
    assert error.max() * params[0] < 0.0056  # pixels: a float32's rounding of components below one half
    assert np.abs(batch.radii.numpy() / expected.radii - 1).max() < 1e-5
    assert np.abs(batch.viewdirs.numpy() - expected.viewdirs).max() < 2e-7


def test_rays_within_the_plane_of_a_face_are_finite(form):
    camera = Camera("PINHOLE", 3, 3, [1.0, 1.0, 1.5, 1.5])
    batch, _ = form(camera, Rigid(np.eye(3), np.array([1.0, 1.0, -3.0])), UNIT, np.arange(9))
    for field in (batch.near, batch.far, batch.viewdirs, batch.radii):
        assert torch.isfinite(field).all()
    assert batch.hit[4]
    assert (batch.near[4].item(), batch.far[4].item()) == (2.0, 4.0)
