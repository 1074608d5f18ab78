"""Figures of a render against a photograph: PSNR, SSIM and LPIPS of the whole frame and of the face.

Images are float [h, w, 3], sRGB-encoded in [0, 1]. A figure that an image is too small for is left out, with the
reason: what is there is still comparable, and an image is never enlarged to be measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from preface.model.evaluation.options import FOREGROUND, LARGEST_PSNR
from preface.model.metrics.image_quality import WINDOW, psnr, ssim
from preface.model.metrics.lpips import LEAST, Lpips, Network

# LPIPS on VGG16 holds some 1.5 kB per pixel of a strip and its surroundings.
STRIP_PIXELS = 2**20
NO_FACE = "the face's middle is not in the image"
NO_FOREGROUND = "the photograph has no foreground"


@dataclass(frozen=True)
class Figures:
    """What was measured.

    Attributes:
        values: by name.
        left_out: why others could not be.
    """

    values: Mapping[str, float]
    left_out: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Judge:
    """Measures pairs of images.

    Attributes:
        networks: LPIPS by the name of its figure.
    """

    networks: Mapping[str, Lpips]

    def whole(self, rgb: np.ndarray, truth: np.ndarray, alpha: np.ndarray, mask: np.ndarray) -> Figures:
        """Figures of a whole frame: `psnr`, `ssim`, LPIPS, `psnr_foreground` and `silhouette_iou`.

        Args:
            rgb, truth: [H, W, 3], both on black.
            alpha, mask: [H, W] in [0, 1], the render's opacity and the photograph's foreground.
        """
        found = self.pair(rgb, truth)
        values, left_out = dict(found.values), dict(found.left_out)
        foreground = mask > FOREGROUND
        if foreground.any():
            values["psnr_foreground"] = _psnr(_tensor(rgb), _tensor(truth), torch.from_numpy(foreground))
            values["silhouette_iou"] = intersection_over_union(alpha > FOREGROUND, foreground)
        else:
            left_out |= dict.fromkeys(("psnr_foreground", "silhouette_iou"), NO_FOREGROUND)
        return Figures(values, left_out)

    def pair(self, rgb: np.ndarray, truth: np.ndarray) -> Figures:
        """`psnr`, `ssim` and LPIPS of two images [h, w, 3]."""
        image, target = _tensor(rgb), _tensor(truth)
        least, size = min(image.shape[:2]), f"{image.shape[1]}x{image.shape[0]}"
        values, left_out = {"psnr": _psnr(image, target)}, {}
        if least < WINDOW:
            left_out["ssim"] = f"{size} pixels are fewer than its window of {WINDOW}"
        else:
            values["ssim"] = ssim(image, target)
        for name, lpips in self.networks.items():
            if least < LEAST[lpips.network]:
                needed = f"{lpips.network} needs {LEAST[lpips.network]}"
                left_out[name] = f"{size} pixels are too few: {needed}"
            else:
                values[name] = _distance(lpips, image, target)
        return Figures(values, left_out)

    def no_face(self) -> Figures:
        """What is said of a view without a face."""
        return Figures({}, dict.fromkeys(("psnr", "ssim", *self.networks), NO_FACE))


def judge(networks: Mapping[str, Network], device: torch.device) -> Judge:
    """A judge with the original weights of these networks, by the name of the figure.

    Raises:
        ArtifactError: the weights are not there; the message has the command that gets them.
    """
    from preface.model.metrics.lpips_weights import load_lpips

    return Judge({name: load_lpips(network).to(device) for name, network in networks.items()})


def intersection_over_union(one: np.ndarray, other: np.ndarray) -> float:
    """Of two masks, bool [H, W], not both empty."""
    return float((one & other).sum() / (one | other).sum())


def _psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    return min(psnr(image, truth, mask), LARGEST_PSNR)


def _distance(lpips: Lpips, image: Tensor, truth: Tensor) -> float:
    device = lpips.shift.device
    ours, theirs = (x.permute(2, 0, 1)[None].float().to(device) for x in (image, truth))
    rows = max(16, STRIP_PIXELS // image.shape[1] // 16 * 16)
    return float(lpips.in_strips(ours, theirs, rows))


def _tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image))
