"""The compiled kernel against its twin in torch, value by value. `test_rays` holds both against the geometry."""

import itertools

import numba
import numpy as np
import pytest
import torch
from numba import types

from preface.geometry import Camera, Rigid, Views
from preface.geometry.transforms import nearest_rotation
from preface.shards import Dataset, Loader, PaperPattern, SingleRays, compiled, compiled_draws
from preface.shards.batches import form_batch
from preface.shards.compiling import compiled_for
from preface.shards.rays import RayTable

WIDTH, HEIGHT = 48, 36
FOCAL = [60.0, 61.0, 23.0, 19.0]
CAMERAS = {
    "pinhole": [Camera("PINHOLE", WIDTH, HEIGHT, FOCAL)],
    "simple radial": [Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, [60.0, 23.0, 19.0, -0.2])],
    "radial": [Camera("RADIAL", WIDTH, HEIGHT, [60.0, 23.0, 19.0, -0.2, 0.1])],
    "opencv": [Camera("OPENCV", WIDTH, HEIGHT, [*FOCAL, -0.1, 0.05, 1e-3, -2e-3])],
    "full": [Camera("FULL_OPENCV", WIDTH, HEIGHT, [*FOCAL, 0.1, -0.2, 1e-3, 1e-3, 0.1, 0.2, 0.1, 0.05])],
    # Eight Newton steps: the corner is seen at nine tenths of the way to the fold.
    "near its fold": [Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, [60.0, 24.0, 18.0, -0.52])],
}
CAMERAS["all of them"] = [camera for cameras in CAMERAS.values() for camera in cameras]
BOX = np.array([[-0.3, -0.2, -0.25], [0.3, 0.2, 0.25]])


def table_of(cameras, scale=1.0):
    """Two identities, the cameras of each around a box: in front, inside, behind, and on a face."""
    places = [[0.0, 0.0, -1.0], [0.1, 0.0, 0.0], [0.2, 0.1, 3.0], [0.3, 0.1, -1.0]]
    turned = nearest_rotation(np.array([[0.9, 0.2, -0.3], [-0.2, 1.0, 0.1], [0.3, -0.05, 0.9]]))
    poses = [
        Rigid(rotation, np.array(places[number % 4]))
        for rotation in (np.eye(3), turned)
        for number in range(len(cameras))
    ]
    views = Views.stack(cameras * 2, poses)
    boxes = np.repeat(BOX[None], len(poses), 0)
    near_far = np.tile([0.5, 0.5], (len(poses), 1))  # near and far are the same
    size = (WIDTH, HEIGHT)
    return RayTable.build(
        views.intrinsics, views.world_from_camera, boxes, near_far, size, scale, torch.device("cpu")
    )


def random_pixels(groups, per_group, views, seed=0):
    rng = np.random.default_rng(seed)
    rgba = torch.from_numpy(rng.integers(-(2**31), 2**31, (groups, per_group)).astype(np.int32))
    identity, view = rng.integers(0, 2, groups), rng.integers(0, views, groups)
    return identity, view, rng.integers(0, WIDTH * HEIGHT, (groups, per_group)), rgba


def both(table, views, identity, view, pixel, rgba):
    tensors = (torch.from_numpy(array) for array in (identity, view))
    expected = form_batch(table, *tensors, views, torch.from_numpy(pixel), rgba)
    found = compiled.CompiledTable(table).form_batch(identity, view, views, pixel, rgba)
    return vars(expected), vars(found)


def roundings(a, b):
    """The largest difference in units of the last place."""
    return float(np.max(np.abs(a - b) / np.spacing(np.maximum(np.abs(a), np.abs(b))), initial=0))


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize(("groups", "per_group"), [(1000, 1), (7, 128), (40, 10), (3, 300), (1, 1), (0, 1)])
def test_every_field_is_that_of_torch(name, groups, per_group):
    table, views = table_of(CAMERAS[name]), len(CAMERAS[name])
    expected, found = both(table, views, *random_pixels(groups, per_group, views))
    assert found["origins"].shape == (groups * per_group, 3)
    for field in ("origins", "rgba", "identity", "view", "hit"):
        assert torch.equal(expected[field], found[field]), field
    for field, allowed in {"directions": 1, "viewdirs": 2, "near": 2, "far": 2, "radii": 4}.items():
        assert roundings(expected[field].numpy(), found[field].numpy()) <= allowed, field
    if groups * per_group > 100:
        assert 0 < found["hit"].float().mean() < 1


def test_rays_that_miss_get_the_depths_of_their_view():
    table = table_of(CAMERAS["opencv"] * 4, scale=2.0)
    _, found = both(table, 4, *random_pixels(2000, 1, 4))
    missed = ~found["hit"]
    assert (found["near"][missed] == 1.0).all()
    assert (found["far"][missed] == 1.0).all()
    behind = found["view"] == 2  # and those of identity 0 look straight away from the box
    assert not found["hit"][behind & (found["identity"] == 0)].any()


@pytest.mark.parametrize("per_group", [1, 100])
def test_a_ray_does_not_depend_on_the_rays_beside_it(per_group):
    cameras = CAMERAS["all of them"]
    kernel = compiled.CompiledTable(table_of(cameras))
    identity, view, pixel, rgba = random_pixels(13, per_group, len(cameras))
    whole = kernel.form_batch(identity, view, len(cameras), pixel, rgba)
    for cuts in ([0, 1, 13], [0, 4, 8, 13], list(range(14))):
        parts = [
            kernel.form_batch(identity[a:b], view[a:b], len(cameras), pixel[a:b], rgba[a:b])
            for a, b in itertools.pairwise(cuts)
        ]
        for field, values in vars(whole).items():
            assert torch.equal(values, torch.cat([getattr(part, field) for part in parts])), field


def test_loaders_of_both_routes_give_the_same_batches(folder):
    with Dataset(folder) as dataset:
        index = dataset.index()
        for sampler in (SingleRays(index, seed=1, rays=3000), PaperPattern(index, 2, 4, 3, 50)):
            fast, plain = (Loader(dataset, sampler, compiled=choice) for choice in (True, False))
            assert fast.route == f"compiled by numba {numba.__version__}"
            assert plain.route == "torch (asked for)"
            for step in (0, 5):
                for field, values in vars(plain.batch(step)).items():
                    if field != "radii":
                        assert torch.equal(values, getattr(fast.batch(step), field)), field


def test_what_a_sampler_may_hand_over_need_not_be_contiguous_or_writable():
    table = table_of(CAMERAS["opencv"])
    identity, view, pixel, rgba = random_pixels(64, 16, 1)
    wide = np.repeat(pixel, 2, axis=1)
    wide.setflags(write=False)
    kernel = compiled.CompiledTable(table)
    expected = kernel.form_batch(identity, view, 1, pixel, rgba)
    found = kernel.form_batch(np.repeat(identity, 2)[::2], view, 1, wide[:, ::2], rgba)
    assert torch.equal(expected.directions, found.directions)


def test_arrays_that_do_not_fit_are_refused_before_memory_is_read():
    identity, view, pixel, rgba = random_pixels(4, 8, 1)
    kernel = compiled.CompiledTable(table_of(CAMERAS["pinhole"]))
    with pytest.raises(IndexError, match="identity"):
        kernel.form_batch(identity + 2, view, 1, pixel, rgba)
    with pytest.raises(IndexError, match="identity"):
        kernel.form_batch(identity, view - 2, 1, pixel, rgba)
    with pytest.raises(ValueError, match="does not fit"):
        kernel.form_batch(identity[:3], view, 1, pixel, rgba)
    with pytest.raises(ValueError, match="does not fit"):
        kernel.form_batch(identity, view, 1, pixel, rgba[:, :7])


def test_without_a_folder_to_keep_the_code_in_it_is_compiled_anew(monkeypatch):
    monkeypatch.setattr("numba.core.caching.CacheImpl._locator_classes", [])
    with pytest.raises(RuntimeError, match="no locator"):
        numba.njit(compiled_draws._below, cache=True)
    signature = (types.uint64, types.int64, types.int64, types.Array(types.int64, 1, "C"))
    drawn = np.empty(5, np.int64)
    compiled_for(compiled_draws._below, *signature)(7, 0, 100, drawn)
    assert drawn.tolist() == compiled_draws.below(7, 0, 5, 100).tolist()
