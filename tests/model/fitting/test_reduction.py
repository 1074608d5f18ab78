"""Views at the prior's resolution: means of light under the mask, and rays through the same points."""

import ball_heads
import numpy as np
import pytest

from preface.geometry import Camera, Rigid, Views
from preface.geometry.rays import cast_rays
from preface.model.fitting.observations import observe
from preface.model.fitting.reduction import reduce_pixels, reduce_views, reduced_size
from preface.shards import Dataset


def light(encoded):
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encoded(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def overlaps(length, count):
    """What part of each source pixel lies in each result pixel, float64 [count, length]."""
    found = np.zeros((count, length))
    for i in range(count):
        low, high = i * length / count, (i + 1) * length / count
        for p in range(length):
            found[i, p] = max(0.0, min(p + 1, high) - max(p, low))
    return found / found.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("size", [(8, 12), (5, 7), (24, 36), (23, 11), (1, 1)])
def test_pixels_are_the_means_of_light_under_the_mask(size):
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 256, (36, 24, 4), dtype=np.uint8)
    pixels[:18, :, 3] = 0
    across, down = overlaps(24, size[0]), overlaps(36, size[1])

    def mean(values):
        return np.einsum("iy,yxc,jx->ijc", down, values, across)

    alpha = pixels[..., 3:] / 255
    mask = mean(alpha)
    weighted = mean(light(pixels[..., :3] / 255) * alpha)
    plain = mean(light(pixels[..., :3] / 255))
    with np.errstate(invalid="ignore"):
        colors = np.where(mask > 0, weighted / mask, plain)
    expected = np.concatenate([encoded(colors), mask], axis=-1) * 255
    found = reduce_pixels(pixels, size)
    assert found.shape == (size[1], size[0], 4)
    assert np.abs(found - expected).max() < 0.51  # a byte's rounding


def test_what_is_behind_a_head_does_not_bleed_into_its_edge():
    pixels = np.zeros((8, 8, 4), np.uint8)
    pixels[...] = (0, 255, 0, 0)
    pixels[:, :3] = (200, 100, 50, 255)
    found = reduce_pixels(pixels, (2, 2))
    assert found[0, 0].tolist() == [200, 100, 50, 191]


@pytest.mark.parametrize(
    ("size", "prior", "expected"),
    [
        ((384, 576), (96, 144), (96, 144)),
        ((96, 144), (96, 144), (96, 144)),
        ((48, 72), (96, 144), (48, 72)),
        ((1000, 1000), (96, 144), (118, 118)),
        ((4096, 1), (16, 16), (1024, 1)),
    ],
)
def test_views_get_as_many_pixels_as_the_priors(size, prior, expected):
    assert reduced_size(size, prior) == expected


def test_reduced_views_are_a_dataset_whose_rays_pass_through_the_same_points(balls, tmp_path):
    with Dataset(balls) as dataset:
        data = observe(dataset, "id0002", ("camera3", "camera1"), None)
        manifest = reduce_views(data, (12, 16), tmp_path / "small")
        with Dataset(manifest) as small:
            assert small.verify() == []
            assert small.names == ("id0002",)
            again = observe(small, None, ("camera3", "camera1"), None)
            np.testing.assert_array_equal(again.scene.box, data.scene.box)
            assert again.scene.scene_scale == data.scene.scene_scale
            np.testing.assert_array_equal(small.pixels(0, 0), reduce_pixels(dataset.pixels(2, 1), (12, 16)))
            corners = np.array([[0.0, 0.0], [24.0, 32.0], [7.0, 9.0]])
            ours, theirs = (
                cast_rays(view(one, *place), corners / factor)
                for one, place, factor in ((dataset, (2, 1), 1), (small, (0, 0), 2))
            )
            np.testing.assert_allclose(theirs.directions, ours.directions, atol=1e-12)
            np.testing.assert_allclose(theirs.origins, ours.origins, atol=0)


def view(dataset, identity, number):
    tables, manifest = dataset.tables, dataset.manifest
    pose = tables["canonical_from_camera"][identity, number]
    camera = Camera("FULL_OPENCV", manifest.width, manifest.height, tables["intrinsics"][identity, number])
    return Views.stack([camera], [Rigid(pose[:, :3], pose[:, 3])])[0]


def test_reduced_views_are_made_once_and_again_for_other_views(balls, tmp_path):
    folder = tmp_path / "small"
    with Dataset(balls) as dataset:
        data = observe(dataset, "id0002", ("camera3",), None)
        first = reduce_views(data, (12, 16), folder).stat().st_mtime_ns
        assert reduce_views(data, (12, 16), folder).stat().st_mtime_ns == first
        other = observe(dataset, "id0001", ("camera3", "camera4"), None)
        reduce_views(other, (6, 8), folder)
    with Dataset(folder) as small:
        assert (small.names, small.manifest.views, small.manifest.width) == (("id0001",), 2, 6)
    assert ball_heads.WIDTH == 24
