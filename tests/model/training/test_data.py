"""What is trained on and what is held out, and that pictures and figures are of what they say."""

import math

import ball_heads
import numpy as np
import pytest
import small_runs
import torch

from preface.model.configuration import carried_levels
from preface.model.model import PriorModel
from preface.model.training.configuration import TrainingConfig
from preface.model.training.data import WholeViews, frontal_view, hold_out, open_data, spread
from preface.model.training.progress import train_flops_per_ray
from preface.model.training.validation import Validation, Viewer, interpolation_sheet, view_sheet
from preface.shards import Dataset, Loader


@pytest.fixture(scope="module")
def data(balls):
    with Dataset(balls) as dataset:
        yield open_data(dataset, TrainingConfig(holdout_views=2, seed=4), small_runs.MODEL)


@pytest.mark.parametrize("count", [0, 1, 3, 99])
def test_each_identity_keeps_a_view_to_train_on(count):
    valid = np.random.default_rng(0).random((50, 6)) < 0.4
    held = hold_out(valid, count, seed=3)
    assert not (held & ~valid).any()
    np.testing.assert_array_equal(held.sum(1), np.minimum(count, np.maximum(valid.sum(1) - 1, 0)))


def test_held_out_views_follow_the_seed_and_are_spread_over_the_cameras():
    valid = np.ones((600, 6), dtype=bool)
    one, again, other = (hold_out(valid, 1, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    assert one.sum(0).min() > 60


def test_held_out_views_are_never_trained_on(data):
    assert not (data.train.valid & data.held_out.valid).any()
    assert data.train.valid.sum() == 3 * 4
    assert data.held_out.valid.sum() == 3 * 2
    assert not data.train.valid[3].any()  # the identity of the other split
    assert data.row.tolist() == [0, 1, 2, -1]
    assert data.names == ("id0000", "id0001", "id0002")
    assert {len(views) for views in data.held_out_names.values()} == {2}


def test_whole_views_are_the_photographs(data):
    pairs = data.held_out.pairs
    loader = Loader(data.dataset, WholeViews(data.train, pairs), scale=data.scene.scene_scale)
    for number, (identity, view) in enumerate(pairs.tolist()):
        batch = loader.batch(number)
        stored = data.dataset.pixels(identity, view).reshape(-1, 4) / 255.0
        np.testing.assert_allclose(batch.rgba.numpy(), stored, atol=1e-6)
        assert set(batch.identity.tolist()) == {identity}
        assert set(batch.view.tolist()) == {view}


@pytest.mark.parametrize(("count", "found"), [(0, 6), (6, 6), (9, 6), (3, 3), (1, 1)])
def test_views_to_look_at_are_spread_over_the_identities(data, count, found):
    chosen = spread(data.held_out, count)
    assert len(chosen) == found
    if count == 3:
        assert len(set(chosen[:, 0].tolist())) == 3


def test_the_frontal_view_is_the_one_straight_ahead(data):
    centers = np.array([pose.translation for pose in ball_heads.poses()])
    expected = np.argmax(centers[:, 2] / np.linalg.norm(centers, axis=1))
    assert frontal_view(data, 1) in np.flatnonzero(np.isclose(centers[:, 2], centers[expected, 2]))


def test_the_smallest_cone_is_that_of_the_nearest_pixel(data):
    """Found by forming all rays and looking."""
    loader = Loader(data.dataset, WholeViews(data.train, data.train.pairs), scale=data.scene.scene_scale)
    batches = [loader.batch(number) for number in range(len(data.train.pairs))]
    seen = min(float((b.radii * b.near)[b.hit].min()) for b in batches)
    assert 0.9 * seen < data.smallest_radius <= 1.001 * seen
    assert carried_levels(data.smallest_radius) in (carried_levels(seen), carried_levels(seen) + 1)


class Truth(torch.nn.Module):
    """In place of a model: sees, half dark, what it was told to see."""

    def __init__(self, colors, acc):
        super().__init__()
        self.config, self.codes = small_runs.MODEL, torch.zeros(3, 8)
        self.colors, self.acc, self.begin = colors, acc, 0

    def forward(self, rays, code):
        from types import SimpleNamespace

        part = slice(self.begin, self.begin + len(rays))
        self.begin = (self.begin + len(rays)) % len(self.colors)
        depth = torch.full((len(rays),), 2.0)
        return SimpleNamespace(rgb=self.colors[part], acc=self.acc[part], distance_median=depth)


@pytest.fixture
def half_dark(data):
    """A viewer whose model sees the first held-out view at half its brightness, and transparent background."""
    identity, view = data.held_out.pairs[0].tolist()
    pixels = torch.from_numpy(data.dataset.pixels(identity, view).reshape(-1, 4) / 255.0).float()
    colors = pixels[:, :3] * pixels[:, 3:]
    viewer = Viewer(Truth(colors / 2, pixels[:, 3]), data, torch.zeros(24, 2), 100)
    return viewer, data.held_out.pairs[:1], pixels.double().numpy()


def test_figures_are_those_of_the_pixels_that_count(half_dark, data):
    viewer, pairs, pixels = half_dark
    loader = Loader(data.dataset, WholeViews(data.train, pairs), scale=data.scene.scene_scale)
    hit = loader.batch(0).hit[:, 0].numpy()
    squared = ((pixels[:, :3] * pixels[:, 3:] / 2) ** 2).mean(1)
    (image,) = viewer.render(pairs)
    assert image.psnr == pytest.approx(-10 * math.log10(squared[hit].mean()), abs=1e-3)
    foreground = hit & (pixels[:, 3] > 0.5)
    assert image.psnr_foreground == pytest.approx(-10 * math.log10(squared[foreground].mean()), abs=1e-3)
    np.testing.assert_allclose(image.rgb, image.truth / 2, atol=1e-6)
    transparent = pixels[:, 3].reshape(image.depth.shape) < 0.5
    np.testing.assert_array_equal(np.isnan(image.depth), transparent)
    np.testing.assert_allclose(image.depth[~transparent], 2.0 / data.scene.scene_scale, rtol=1e-6)


def test_a_perfect_view_has_a_figure_that_can_be_written(half_dark):
    viewer, pairs, _ = half_dark
    viewer.model.colors = viewer.model.colors * 2
    found = Validation.of(viewer, pairs)
    assert found.figures == {"views": 1, "psnr": 100.0, "psnr_foreground": 100.0}


def test_sheets_hold_a_row_per_view_and_per_pair(half_dark, data):
    viewer, pairs, _ = half_dark
    found = Validation.of(viewer, np.concatenate([pairs] * 3))
    one, three = (view_sheet(found.shown[:n], data.scene.near_far) for n in (1, 3))
    assert three.shape[0] == pytest.approx(3 * one.shape[0], rel=0.02)
    assert three.shape[1] == one.shape[1]
    rows = viewer.interpolate([(0, 2), (1, 0)])
    assert [len(row) for row in rows] == [7, 7]
    sheet = interpolation_sheet(rows, [("a", "b"), ("c", "d")])
    assert sheet.shape[1] > 7 * ball_heads.WIDTH * 6


def test_faces_between_begin_and_end_with_the_identities(data):
    torch.manual_seed(0)
    model = PriorModel(small_runs.MODEL, 3)
    model.codes.data *= 100
    viewer = Viewer(model, data, torch.zeros(24, 2), 1000)
    (row,) = viewer.interpolate([(0, 2)])
    model.codes.data[0] = model.codes.data[2]
    (other,) = viewer.interpolate([(0, 2)])
    np.testing.assert_array_equal(other[0], row[-1])
    np.testing.assert_array_equal(other[-1], row[-1])
    assert np.abs(row[0] - row[-1]).max() > 1e-4


def test_operations_per_ray_are_those_that_torch_counts(data):
    from torch.utils.flop_counter import FlopCounterMode

    torch.manual_seed(0)
    model = PriorModel(small_runs.MODEL, 3)
    loader = Loader(data.dataset, WholeViews(data.train, data.train.pairs), scale=data.scene.scene_scale)
    from preface.model.rays import Rays

    rays = Rays.from_batch(loader.batch(0))
    with FlopCounterMode(display=False) as counter:
        render = model(rays, model.codes[:1])
        (render.rgb.sum() + sum(level.weights.sum() for level in render.levels)).backward()
    per_ray = counter.get_total_flops() / len(render.levels[-1].weights)
    assert train_flops_per_ray(model) == pytest.approx(per_ray, rel=0.1)
