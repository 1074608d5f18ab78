"""Figures of pairs of images whose values are known, and what is left out."""

import math

import numpy as np
import pytest
import torch

from preface.model.evaluation.figures import NO_FOREGROUND, Judge, intersection_over_union, judge
from preface.model.evaluation.metrics_file import mean_of

PLAIN = Judge({})


def frames(height=20, width=18, seed=0):
    rng = np.random.default_rng(seed)
    truth = rng.random((height, width, 3), dtype=np.float32)
    mask = np.zeros((height, width), np.float32)
    mask[5:15, 4:12] = 1
    return truth, mask


@pytest.mark.parametrize("error", [0.5, 0.1, 1e-3])
def test_a_constant_error_has_the_psnr_of_the_formula(error):
    truth = np.full((12, 12, 3), 0.25)
    assert PLAIN.pair(truth + error, truth).values["psnr"] == pytest.approx(-20 * math.log10(error), abs=1e-9)


def test_equal_images_have_the_largest_psnr_that_can_be_written():
    truth, mask = frames()
    found = PLAIN.whole(truth, truth, mask, mask).values
    assert found["psnr"] == found["psnr_foreground"] == 100
    assert found["ssim"] == pytest.approx(1)
    assert found["silhouette_iou"] == 1


def test_only_foreground_counts_in_its_psnr():
    truth, mask = frames()
    rgb = truth.copy()
    rgb[mask == 0] = 1 - rgb[mask == 0]
    rgb[mask > 0] += 0.1
    found = PLAIN.whole(rgb, truth, mask, mask).values
    assert found["psnr_foreground"] == pytest.approx(20, abs=1e-4)
    squared = ((rgb.astype(np.float64) - truth) ** 2).mean()
    assert found["psnr"] == pytest.approx(-10 * np.log10(squared), abs=1e-9)


def test_silhouettes_are_compared_where_either_is_more_than_half():
    truth, mask = frames()
    alpha = np.zeros_like(mask)
    alpha[10:20, 4:12] = 0.51  # half of the foreground, and as much again below it
    alpha[:5] = 0.49
    assert PLAIN.whole(truth, truth, alpha, mask).values["silhouette_iou"] == pytest.approx(1 / 3)
    assert intersection_over_union(mask > 0, mask == 0) == 0


def test_a_photograph_without_foreground_has_no_foreground_figures():
    truth, mask = frames()
    found = PLAIN.whole(truth, truth, mask, np.zeros_like(mask))
    assert set(found.values) == {"psnr", "ssim"}
    assert found.left_out == {"psnr_foreground": NO_FOREGROUND, "silhouette_iou": NO_FOREGROUND}


@pytest.mark.parametrize(
    ("side", "there"),
    [
        (31, {"psnr", "ssim", "lpips", "lpips_alex"}),
        (30, {"psnr", "ssim", "lpips"}),
        (15, {"psnr", "ssim"}),
        (10, {"psnr"}),
        (1, {"psnr"}),
    ],
)
def test_figures_that_an_image_is_too_small_for_are_left_out_with_the_reason(both_networks, side, there):
    truth = np.zeros((side, 40, 3), np.float32)
    found = both_networks.pair(truth + 0.1, truth)
    assert set(found.values) == there
    assert set(found.left_out) == {"psnr", "ssim", "lpips", "lpips_alex"} - there
    assert all(f"40x{side} pixels" in why for why in found.left_out.values())


@pytest.fixture(scope="module")
def both_networks() -> Judge:
    return judge({"lpips": "vgg", "lpips_alex": "alex"}, torch.device("cpu"))


def test_lpips_is_the_original_s_on_the_golden_pair(both_networks):
    """FACTS of the original program: 0.427303 on VGG, 0.344936 on AlexNet, noise against the photograph."""
    from pathlib import Path

    with np.load(Path(__file__).parents[2] / "data" / "lpips_pairs.npz") as pairs:
        truth, noisy = (pairs[name].astype(np.float32) / 255 for name in ("a", "noise"))
    found = both_networks.pair(noisy, truth).values
    assert found["lpips"] == pytest.approx(0.427303, abs=1e-5)
    assert found["lpips_alex"] == pytest.approx(0.344936, abs=1e-5)


def test_means_are_over_the_views_that_have_a_figure():
    views = [{"psnr": 20.0, "ssim": 0.5}, {"psnr": 30.0}, {"psnr": 25.0, "ssim": 0.7}]
    assert mean_of(views) == {"psnr": pytest.approx(25), "ssim": pytest.approx(0.6)}
