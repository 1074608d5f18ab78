"""PSNR and SSIM against loops over windows in plain numpy, and at their ends."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from preface.model.metrics.image_quality import psnr, ssim, ssim_map


def windows_ssim(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Equation 13 of Wang et al. 2004, window by window."""
    x = np.arange(11) - 5
    weights = np.exp(-(x[:, None] ** 2 + x[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    out = np.empty((a.shape[0] - 10, a.shape[1] - 10, a.shape[2]))
    for y, z, c in np.ndindex(*out.shape):
        p, q = a[y : y + 11, z : z + 11, c], b[y : y + 11, z : z + 11, c]
        mp, mq = (weights * p).sum(), (weights * q).sum()
        vp, vq = (weights * (p - mp) ** 2).sum(), (weights * (q - mq) ** 2).sum()
        covariance = (weights * (p - mp) * (q - mq)).sum()
        out[y, z, c] = (2 * mp * mq + 1e-4) * (2 * covariance + 9e-4)
        out[y, z, c] /= (mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)
    return out


def pictures(seed: int, height: int = 15, width: int = 13) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.random((height, width, 3))
    return np.clip(truth + rng.normal(0, 0.1, truth.shape), 0, 1), truth


@given(st.integers(0, 1000), st.sampled_from([11, 12, 20]))
@settings(max_examples=15, deadline=None)
def test_ssim_is_what_the_loop_over_windows_gives(seed, height):
    a, b = pictures(seed, height)
    ours = ssim_map(torch.from_numpy(a), torch.from_numpy(b))
    np.testing.assert_allclose(ours.numpy(), windows_ssim(a, b), atol=1e-12)
    assert ssim(torch.from_numpy(a), torch.from_numpy(b)) == pytest.approx(
        windows_ssim(a, b).mean(), abs=1e-12
    )


@pytest.mark.parametrize("level", [0.0, 1e-6, 0.5, 1.0])
def test_equal_constant_images_are_perfectly_alike(level):
    image = torch.full((16, 16, 3), level)
    assert ssim(image, image) == pytest.approx(1, abs=1e-9)
    assert psnr(image, image) == math.inf


def test_ssim_in_float32_is_that_of_float64():
    a, b = (torch.from_numpy(x) for x in pictures(3, 40, 50))
    assert ssim(a.float(), b.float()) == pytest.approx(ssim(a, b), abs=1e-6)


@pytest.mark.parametrize("error", [1e-9, 1e-3, 0.1, 1.0])
def test_psnr_of_a_constant_error(error):
    truth = torch.zeros(4, 5, 3, dtype=torch.float64)
    assert psnr(truth + error, truth) == pytest.approx(-20 * math.log10(error), abs=1e-9)


def test_only_pixels_of_the_mask_count():
    truth, mask = torch.zeros(4, 4, 3), torch.zeros(4, 4, dtype=torch.bool)
    mask[1, 2] = True
    image = torch.rand(4, 4, 3)
    image[1, 2] = 0.1
    assert psnr(image, truth, mask) == pytest.approx(20, abs=1e-5)


def test_bad_input_says_what_is_wrong():
    image = torch.zeros(12, 12, 3)
    with pytest.raises(ValueError, match="not two images"):
        psnr(image, torch.zeros(12, 13, 3))
    with pytest.raises(ValueError, match="not finite"):
        ssim(image + math.nan, image)
    with pytest.raises(ValueError, match="smaller than"):
        ssim(image[:10], image[:10])
    with pytest.raises(ValueError, match="no pixel counts"):
        psnr(image, image, torch.zeros(12, 12, dtype=torch.bool))
    with pytest.raises(ValueError, match="mask"):
        psnr(image, image, torch.zeros(11, 12, dtype=torch.bool))
