"""PSNR and SSIM of images in [0, 1], in float64 whatever they come in.

SSIM as Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity", equation 13:
a Gaussian window of 11x11 with sigma 1.5, K1 = 0.01, K2 = 0.03, population covariances, only where the window lies
inside the image, each channel by itself and then their mean. multinerf, and scikit-image with
``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``, measure the same.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW, SIGMA = 11, 1.5
K1, K2 = 0.01, 0.03


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB for a peak of one; infinite for equal images.

    Args:
        image, truth: [h, w, c].
        mask: bool [h, w], the pixels that count; all by default.

    Raises:
        ValueError: shapes differ, a value is not finite, or no pixel counts.
    """
    ours, theirs = _checked(image, truth)
    squared = (ours - theirs) ** 2
    if mask is not None:
        if mask.shape != squared.shape[:2] or mask.dtype != torch.bool:
            raise ValueError(f"mask: {tuple(mask.shape)} {mask.dtype} is not bool {tuple(squared.shape[:2])}")
        squared = squared[mask]
    if squared.numel() == 0:
        raise ValueError("mask: no pixel counts; leave the view out of the mean")
    error = float(squared.mean())
    return -10 * math.log10(error) if error > 0 else math.inf


def ssim(image: Tensor, truth: Tensor) -> float:
    """Structural similarity, at most 1; settings as in the header.

    Args:
        image, truth: [h, w, c], at least 11 x 11.

    Raises:
        ValueError: shapes differ, a value is not finite, or the images are smaller than the window.
    """
    return float(ssim_map(image, truth).mean())


def ssim_map(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM of every window that lies inside the images, float64 [h - 10, w - 10, c]; as `ssim`."""
    ours, theirs = _checked(image, truth)
    if min(ours.shape[:2]) < WINDOW:
        raise ValueError(f"image: {ours.shape[1]}x{ours.shape[0]} is smaller than SSIM's {WINDOW}x{WINDOW}")
    a, b = (x.movedim(-1, 0)[:, None] for x in (ours, theirs))  # channels as a batch
    mean_a, mean_b = _blur(a), _blur(b)
    # Rounding can take a variance just below zero; about the pair's mean it hardly can.
    offset = (a.mean() + b.mean()) / 2
    da, db = a - offset, b - offset
    ma, mb = mean_a - offset, mean_b - offset
    var_a = (_blur(da * da) - ma * ma).clamp_min(0)
    var_b = (_blur(db * db) - mb * mb).clamp_min(0)
    covariance = _blur(da * db) - ma * mb
    luminance = (2 * mean_a * mean_b + K1**2) / (mean_a**2 + mean_b**2 + K1**2)
    structure = (2 * covariance + K2**2) / (var_a + var_b + K2**2)
    return (luminance * structure)[:, 0].movedim(0, -1)


def _blur(x: Tensor) -> Tensor:
    """Gaussian mean of [n, 1, h, w] over the windows inside it."""
    offsets = torch.arange(WINDOW, dtype=x.dtype, device=x.device) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    weights = weights / weights.sum()
    return conv2d(conv2d(x, weights.view(1, 1, -1, 1)), weights.view(1, 1, 1, -1))


def _checked(image: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    if image.shape != truth.shape or image.dim() != 3:
        raise ValueError(
            f"image: {tuple(image.shape)} and {tuple(truth.shape)} are not two images [h, w, c] alike"
        )
    for name, values in (("image", image), ("truth", truth)):
        if not torch.isfinite(values).all():
            raise ValueError(f"{name}: a value is not finite")
    return image.double(), truth.double()
