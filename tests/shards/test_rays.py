"""Rays of shards against the geometry layer, in float64, and against the cameras that took the pictures."""

import math

import numpy as np
import pytest
import small_heads
import torch

from preface.geometry import Camera, Rigid, Views, cast_rays, intersect_box, pixel_centers
from preface.shards import Dataset, Loader, Patches, SingleRays
from preface.shards.batches import form_batch
from preface.shards.compiled import CompiledTable
from preface.shards.rays import LensError, RayTable

CPU = torch.device("cpu")


def by_torch(table, pixels):
    nothing = torch.zeros(1, dtype=torch.int64)
    return form_batch(
        table, nothing, nothing, 1, pixels[None], torch.zeros(1, len(pixels), dtype=torch.int32)
    )


def compiled(table, pixels):
    nothing = np.zeros(1, dtype=np.int64)
    colours = torch.zeros(1, len(pixels), dtype=torch.int32)
    return CompiledTable(table).form_batch(nothing, nothing, 1, pixels.numpy()[None], colours)


@pytest.fixture(params=[by_torch, compiled])
def rays_of(request):
    """All rays of a camera, or those of some pixels, formed in each way that there is."""

    def form(camera, pose, box=small_heads.BOX, scale=1.0, pixels=None):
        views = Views.stack([camera], [pose])
        near_far = np.array([[0.25, 4.0]])
        size = (camera.width, camera.height)
        table = RayTable.build(
            views.intrinsics, views.world_from_camera, box[None], near_far, size, scale, CPU
        )
        pixels = torch.arange(camera.width * camera.height) if pixels is None else pixels
        return request.param(table, pixels), views

    return form


@pytest.mark.parametrize("view", range(small_heads.VIEWS))
@pytest.mark.parametrize("size", [(24, 20), (150, 131)])
def test_rays_are_those_of_the_geometry_layer(view, size, rays_of):
    cameras, poses = small_heads.rig_cameras(*size)
    batch, views = rays_of(cameras[view], poses[view])
    expected = cast_rays(views[0], pixel_centers(*size).reshape(-1, 2))
    assert expected.valid.all()
    assert np.abs(batch.origins.numpy() - expected.origins).max() < 6e-8
    assert np.abs(batch.directions.numpy() - expected.directions).max() < 6.5e-8  # half an ulp of 1
    assert np.abs(batch.viewdirs.numpy() - expected.viewdirs).max() < 2e-7
    assert np.abs(batch.radii.numpy() / expected.radii - 1).max() < 1e-5
    near, far, hit = intersect_box(*small_heads.BOX, expected.origins, expected.directions)
    ours = batch.hit.numpy()[:, 0]
    grazing = hit & (far - near < 1e-6)
    assert np.array_equal(ours[~grazing], hit[~grazing])
    both = ours & hit
    assert 0.02 < both.mean() < 1
    assert np.abs(batch.near.numpy()[both, 0] - near[both]).max() < 1e-6
    assert np.abs(batch.far.numpy()[both, 0] - far[both]).max() < 1e-6
    assert (batch.near[~batch.hit] == 0.25).all()
    assert (batch.far[~batch.hit] == 4.0).all()


@pytest.mark.parametrize("view", range(small_heads.VIEWS))
def test_a_ray_of_a_shards_pixel_meets_its_pixel_in_the_original_camera(folder, view):
    """Under 0.01 px and 1 um: points on rays of the batch, back through the alignment into the rig's camera."""
    cameras, poses = small_heads.rig_cameras()
    with Dataset(folder) as dataset:
        loader = Loader(
            dataset, Patches(dataset.index().only([2]), seed=0, patches=16, size=20), placement="ram"
        )
        batch, pick = (
            loader.batch(0),
            Patches(dataset.index().only([2]), seed=0, patches=16, size=20).pick(0, 0, 1),
        )
    of_view = batch.view.numpy() == view
    assert of_view.any()
    pixel = pick.pixel.reshape(-1)[of_view]
    target = np.stack([pixel % 24 + 0.5, pixel // 24 + 0.5], -1)
    similarity = small_heads.alignment(2)
    centre = similarity.inverse.apply(batch.origins.numpy()[of_view].astype(np.float64))
    assert np.linalg.norm(centre - poses[view].translation, axis=-1).max() < 1e-6
    for depth in (0.5, 1.0, 1.5):
        points = batch.origins.double().numpy()[of_view] + depth * batch.directions.double().numpy()[of_view]
        in_camera = poses[view].inverse.apply(similarity.inverse.apply(points))
        seen, valid = cameras[view].project(in_camera)
        assert valid.all()
        # 24 pixels across; the same share of a 4096-pixel image must stay under 0.01 px.
        assert np.abs(seen - target).max() * 4096 / 24 < 0.01


def test_colours_are_the_bytes_of_the_image(folder):
    with Dataset(folder) as dataset:
        sampler = SingleRays(dataset.index(), seed=3, rays=500)
        batch, pick = Loader(dataset, sampler, placement="mmap").batch(7), sampler.pick(7, 0, 1)
        for ray in range(0, 500, 7):
            identity, view = int(batch.identity[ray]), int(batch.view[ray])
            y, x = divmod(int(pick.pixel[ray, 0]), 24)
            expected = dataset.pixels(identity, view)[y, x]
            assert np.array_equal(np.rint(batch.rgba[ray].numpy() * 255), expected)
            assert batch.rgb[ray].numpy().tolist() == (expected[:3] / np.float32(255)).tolist()
            assert batch.alpha[ray].item() == expected[3] / np.float32(255)


def test_scaling_scales_lengths_and_nothing_else(rays_of):
    cameras, poses = small_heads.rig_cameras()
    metres, _ = rays_of(cameras[0], poses[0])
    scaled, _ = rays_of(cameras[0], poses[0], scale=4.0)
    for name in ("directions", "viewdirs", "radii", "hit"):
        assert torch.equal(getattr(metres, name), getattr(scaled, name))
    for name in ("origins", "near", "far"):
        torch.testing.assert_close(4 * getattr(metres, name), getattr(scaled, name), rtol=1e-6, atol=0)


def test_the_last_pixel_of_a_huge_image_has_its_own_ray(rays_of):
    camera = Camera("PINHOLE", 40_000, 30_000, [50_000.0, 50_000.0, 20_000.0, 15_000.0])
    index = torch.tensor([0, 39_999, 40_000, 40_000 * 30_000 - 1])
    batch, _ = rays_of(camera, Rigid.identity(), pixels=index)
    expected = (np.array([[0, 0], [39_999, 0], [0, 1], [39_999, 29_999]]) + 0.5 - (20_000, 15_000)) / 50_000
    assert np.abs(batch.directions[:, :2].numpy() - expected).max() < 3e-8


def test_depths_inside_the_box_along_its_faces_and_in_their_plane(rays_of):
    """Rays straight along z from inside, and a camera in the plane of a face of the box."""
    camera = Camera("PINHOLE", 1, 1, [1.0, 1.0, 0.5, 0.5])
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    inside, _ = rays_of(camera, Rigid.identity(), box)
    assert (inside.near.item(), inside.far.item(), inside.hit.item()) == (0.0, 1.0, True)
    on_face, _ = rays_of(camera, Rigid(np.eye(3), np.array([1.0, 0, -3])), box)
    assert (on_face.near.item(), on_face.far.item(), on_face.hit.item()) == (2.0, 4.0, True)
    beside, _ = rays_of(camera, Rigid(np.eye(3), np.array([1.5, 0, -3])), box)
    assert (beside.near.item(), beside.far.item(), beside.hit.item()) == (0.25, 4.0, False)
    behind, _ = rays_of(camera, Rigid(np.eye(3), np.array([0.0, 0, 3])), box)
    assert not behind.hit.item()


def test_strong_distortion_takes_more_steps_and_stays_exact(rays_of):
    camera = Camera("RADIAL", 64, 64, [40.0, 32.0, 32.0, -0.12, 0.03])
    batch, views = rays_of(camera, Rigid.identity())
    expected = cast_rays(views[0], pixel_centers(64, 64).reshape(-1, 2))
    assert expected.valid.all()
    assert np.abs(batch.directions.numpy() - expected.directions).max() < 2e-7
    assert np.abs(batch.radii.numpy() / expected.radii - 1).max() < 1e-5


def test_a_lens_that_folds_is_refused(rays_of):
    with pytest.raises(LensError, match="folds"):
        rays_of(Camera("SIMPLE_RADIAL", 64, 64, [40.0, 32.0, 32.0, -0.6]), Rigid.identity())


def test_radii_are_those_of_a_pinhole(rays_of):
    batch, _ = rays_of(Camera("PINHOLE", 4, 4, [10.0, 20.0, 2.0, 2.0]), Rigid.identity())
    assert batch.radii.numpy() == pytest.approx(2 / math.sqrt(12) * (1 / 10 + 1 / 20) / 2, rel=1e-6)
