"""Samplers: the same global stream for any number of processes and after any restart, and what they draw."""

import numpy as np
import pytest
import torch
from small_heads import HEIGHT, NAMES, WIDTH

from preface.artifacts import ArtifactError
from preface.shards import Dataset, Loader, PaperPattern, Patches, SingleRays, ViewIndex, compiled_draws
from preface.shards.samplers import single_rays_by_numpy
from preface.shards.streams import below

VALID = np.arange(70 * 5).reshape(70, 5) % 7 != 3
BOXES = np.tile([2, 3, 9, 14], (70, 5, 1))


def index(order="raster"):
    return ViewIndex(VALID, 16, 24, order, BOXES)


SAMPLERS = {
    "paper": lambda: PaperPattern(index(), seed=5),
    "paper, permuted": lambda: PaperPattern(index("permuted"), seed=5, identities=10, views=3, rays=16),
    "single": lambda: SingleRays(index(), seed=5, rays=1001),
    "single, foreground": lambda: SingleRays(index("permuted"), seed=5, rays=1001, foreground_share=0.5),
    "patches": lambda: Patches(index(), seed=5, patches=13, size=8),
}


def arrays(pick):
    return [pick.identity, pick.view, pick.pixel, pick.slot]


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("world", [1, 2, 8, 3])
def test_every_world_size_draws_the_same_global_stream(name, world):
    whole = SAMPLERS[name]()
    for step in (0, 1, 999, 10**9):
        parts = [SAMPLERS[name]().pick(step, rank, world) for rank in range(world)]  # each in a new process
        for expected, *found in zip(arrays(whole.pick(step, 0, 1)), *map(arrays, parts), strict=True):
            assert np.array_equal(expected, np.concatenate(found))


@pytest.mark.parametrize("steps", [100, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SAMPLERS)
def test_a_stream_with_restarts_in_other_world_sizes_is_the_stream(name, steps):
    uninterrupted = SAMPLERS[name]()
    worlds, every = [1, 2, 8, 3], 7
    for step in range(steps):
        if step % every == 0:  # a restart
            world, sampler = worlds[(step // every) % 4], SAMPLERS[name]()
        parts = [arrays(sampler.pick(step, rank, world)) for rank in range(world)]
        for expected, *found in zip(arrays(uninterrupted.pick(step, 0, 1)), *parts, strict=True):
            assert np.array_equal(expected, np.concatenate(found))


@pytest.mark.parametrize("name", SAMPLERS)
def test_steps_and_seeds_differ(name):
    import dataclasses

    sampler = SAMPLERS[name]()
    other = dataclasses.replace(sampler, seed=6)
    first = sampler.pick(0, 0, 1).pixel
    assert not np.array_equal(first, sampler.pick(1, 0, 1).pixel)
    assert not np.array_equal(first, other.pick(0, 0, 1).pixel)


@pytest.mark.parametrize("name", SAMPLERS)
def test_only_views_that_exist_are_drawn(name):
    sampler = SAMPLERS[name]()
    for step in range(20):
        pick = sampler.pick(step, 0, 1)
        assert VALID[pick.identity, pick.view].all()
        assert pick.pixel.min() >= 0
        assert pick.pixel.max() < 16 * 24


def test_the_papers_pattern_has_different_identities_and_views():
    pick = PaperPattern(index(), seed=1, identities=64, views=3).pick(4, 0, 1)
    identities, views = pick.identity.reshape(64, 3), pick.view.reshape(64, 3)
    assert len(set(identities[:, 0])) == 64
    assert (identities == identities[:, :1]).all()
    assert all(len(set(row)) == 3 for row in views)
    assert pick.pixel.shape == (192, 128)


def test_a_run_of_permuted_slots_is_spread_over_the_image():
    pick = PaperPattern(index("permuted"), seed=1, identities=4, views=2, rays=64).pick(0, 0, 1)
    assert (np.diff(pick.slot, axis=1) % (16 * 24) == 1).all()
    assert all(len(set(row // 16)) > 12 for row in pick.pixel)  # of 24 image rows


def test_pixels_are_drawn_uniformly():
    sampler = SingleRays(index(), seed=2, rays=20_000)
    drawn = np.concatenate([sampler.pick(step, 0, 1).pixel[:, 0] for step in range(10)])
    counts, expected = np.bincount(drawn, minlength=384), 200_000 / 384
    assert ((counts - expected) ** 2 / expected).sum() < 383 + 3.3 * np.sqrt(2 * 383)


def test_foreground_share_draws_that_share_from_the_boxes():
    sampler = SingleRays(index(), seed=2, rays=50_000, foreground_share=0.75)
    y, x = np.divmod(sampler.pick(0, 0, 1).pixel[:, 0], 16)
    inside = ((x >= 2) & (x < 9) & (y >= 3) & (y < 14)).mean()
    expected = 0.75 + 0.25 * 7 * 11 / 384
    assert abs(inside - expected) < 4 * np.sqrt(expected * (1 - expected) / 50_000)


def test_views_without_a_foreground_are_not_drawn_from_boxes():
    boxes = np.array([[[0, 0, 0, 0], [4, 4, 8, 10], [0, 0, 0, 0]]])
    three = ViewIndex(np.ones((1, 3), bool), 16, 24, "raster", boxes)
    pick = SingleRays(three, seed=0, rays=3000, foreground_share=1.0).pick(0, 0, 1)
    y, x = np.divmod(pick.pixel[:, 0], 16)
    assert (pick.view == 1).all()
    assert (x.min(), x.max(), y.min(), y.max()) == (4, 7, 4, 9)


def test_foreground_draws_are_uniform_over_boxes_of_any_size():
    valid = np.array([[True, True]])
    boxes = np.array([[[0, 0, 2, 2], [4, 4, 8, 10]]])
    sampler = SingleRays(ViewIndex(valid, 16, 24, "raster", boxes), seed=0, rays=28_000, foreground_share=1.0)
    pick = sampler.pick(0, 0, 1)
    counts = np.bincount(pick.view * 384 + pick.pixel[:, 0], minlength=768)
    assert np.count_nonzero(counts) == 4 + 24
    assert np.abs(counts[counts > 0] - 1000).max() < 5 * np.sqrt(1000)


@pytest.mark.parametrize("draw", [compiled_draws.single_rays, single_rays_by_numpy])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("views", [1, 2, 5, 18])
def test_single_rays_are_pixels_by_their_number_among_all_or_among_those_of_the_boxes(draw, share, views):
    width, height, begin, count, bound = 7, 5, 11, 3000, round(share * 2**53)
    rng = np.random.default_rng(views)
    corners = np.sort(rng.integers(0, 6, (views, 2, 2)), axis=1).reshape(
        views, 4
    )  # x0 y0 x1 y1, some of them empty
    corners[-1] = [0, 0, 2, 5]
    boxes = np.array([corners[:, 0], corners[:, 1], corners[:, 2] - corners[:, 0]])
    within = [[y * width + x for y in range(y0, y1) for x in range(x0, x1)] for x0, y0, x1, y1 in corners]
    areas = np.cumsum([len(pixels) for pixels in within])
    everywhere = [(view, pixel) for view in range(views) for pixel in range(width * height)]
    inside = [(view, pixel) for view in range(views) for pixel in within[view]]

    keys = (91, 92, 93)
    uniform, chance, boxed = (
        below(key, begin, count, limit)
        for key, limit in zip(keys, (len(everywhere), 2**53, len(inside)), strict=True)
    )
    numbers = zip(uniform, chance, boxed, strict=True)
    expected = [inside[b] if c < bound else everywhere[u] for u, c, b in numbers]
    found = draw(keys, bound, begin, count, (width, height), boxes, areas)
    assert np.array_equal(np.stack(found, axis=1), expected)


def test_patches_are_squares_of_neighbours():
    pick = Patches(index(), seed=3, patches=20, size=8).pick(0, 0, 1)
    y, x = np.divmod(pick.pixel.reshape(20, 8, 8), 16)
    assert (np.diff(x, axis=2) == 1).all()
    assert (np.diff(y, axis=1) == 1).all()
    assert (np.diff(y, axis=2) == 0).all()


@pytest.mark.parametrize("placement", ["ram", "mmap", "auto"])
def test_loaders_in_any_placement_and_world_give_the_same_batches(folder, placement):
    with Dataset(folder) as dataset:
        sampler = PaperPattern(dataset.index("train"), seed=9, identities=4, views=2, rays=8)
        reference = Loader(dataset, sampler, placement="ram")
        loaders = [Loader(dataset, sampler, placement=placement, rank=rank, world=3) for rank in range(3)]
        for step, *parts in zip(range(5, 9), *(loader.batches(5, 9) for loader in loaders), strict=True):
            assert [number for number, _ in parts] == [step] * 3
            for name, whole in vars(reference.batch(step)).items():
                assert torch.equal(whole, torch.cat([getattr(batch, name) for _, batch in parts])), name


def test_splits_are_kept_apart(folder):
    with Dataset(folder) as dataset:
        assert dataset.manifest.splits == {"train": tuple(NAMES[:4]), "holdout": tuple(NAMES[4:])}
        sampler = SingleRays(dataset.index("holdout"), seed=0, rays=200)
        assert set(sampler.pick(0, 0, 1).identity) == {4}


def test_leaving_the_iteration_ends_the_thread(folder):
    import threading

    with Dataset(folder) as dataset:
        loader = Loader(dataset, SingleRays(dataset.index(), seed=0, rays=10))
        for step, _ in loader.batches(0):
            if step == 3:
                break
        assert not [t for t in threading.enumerate() if t.name == "preface-batches"]


def test_errors_of_the_background_reach_the_trainer(folder, monkeypatch):
    with Dataset(folder) as dataset:
        loader = Loader(dataset, SingleRays(dataset.index(), seed=0, rays=10))
        formed = loader.batch

        def fails_at_two(step):
            if step == 2:
                raise ArtifactError("shard", "file", "is damaged", "Restore it")
            return formed(step)

        monkeypatch.setattr(loader, "batch", fails_at_two)
        seen = []
        with pytest.raises(ArtifactError, match="damaged"):
            seen += [step for step, _ in loader.batches(0)]
        batches = loader.batches(0)
        assert [next(batches)[0], next(batches)[0]] == [0, 1]


def test_pictures_round_trip(folder):
    import small_heads

    with Dataset(folder) as dataset:
        assert dataset.names == tuple(NAMES)
        for number in range(len(dataset)):
            for view in np.flatnonzero(dataset.tables["view_valid"][number]):
                assert np.array_equal(dataset.pixels(number, view), small_heads.head(number).pixels[view])
        assert dataset.tables["keypoints"].shape == (5, 5, 3)
        assert np.isnan(dataset.tables["keypoints"][2, 2, 0])
        assert dataset.pixels(0, 0).shape == (HEIGHT, WIDTH, 4)
        assert dataset.manifest.scene_scale == pytest.approx(1 / 0.21)


def test_bad_samplers_are_refused():
    empty = ViewIndex(np.zeros((3, 2), bool), 16, 24, "raster", np.zeros((3, 2, 4), int))
    with pytest.raises(ValueError, match="no identity"):
        PaperPattern(empty, seed=0)
    with pytest.raises(ValueError, match="does not fit"):
        Patches(index(), seed=0, size=17)
    with pytest.raises(ValueError, match="between 0 and 1"):
        SingleRays(index(), seed=0, foreground_share=1.5)
    with pytest.raises(ValueError, match="rank"):
        Patches(index(), seed=0, size=8).pick(0, 2, 2)
