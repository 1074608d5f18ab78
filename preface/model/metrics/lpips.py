"""LPIPS: the distance of two images in the features of a network trained to see.

Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", equation 1, version
0.1 with its learned linear weights, on AlexNet or VGG16. The weights are the original ones; `lpips_weights` gets
them. Gradients reach the images and never the weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, max_pool2d

Network = Literal["alex", "vgg"]
NETWORKS: tuple[Network, ...] = ("alex", "vgg")
# Of the ImageNet images in [-1, 1] that the networks were trained on.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
FLOOR = 1e-10  # added to the length of a feature vector, as in the original

# The levels at whose end features are compared: the pooling before them (0: none), then the stride and padding of
# their convolutions, each followed by ReLU.
_LEVELS: dict[Network, list[tuple[int, list[tuple[int, int]]]]] = {
    "alex": [(0, [(4, 2)]), (3, [(1, 2)]), (3, [(1, 1)]), (0, [(1, 1)]), (0, [(1, 1)])],
    "vgg": [(0, [(1, 1)] * 2), (2, [(1, 1)] * 2), (2, [(1, 1)] * 3), (2, [(1, 1)] * 3), (2, [(1, 1)] * 3)],
}
LEAST: dict[Network, int] = {"alex": 31, "vgg": 16}  # below, a pooling has nothing left
# Pixels per row of features at each level; strips begin at multiples of the coarsest.
_STRIDES: dict[Network, tuple[int, ...]] = {"alex": (4, 8, 16, 16, 16), "vgg": (1, 2, 4, 8, 16)}
# Rows above and below a strip that its features depend on: the last level's sees 163 (alex) or 196 (vgg) rows, fewer
# than this to either side.
_HALO = 176


class Lpips(nn.Module):
    """The distance, for batches of images.

    Attributes:
        network: ``alex`` or ``vgg``.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, network: Network, weights: Mapping[str, Tensor]):
        """Take the weights of a network, as `lpips_weights.load` returns them."""
        super().__init__()
        self.network = network
        for name, value in weights.items():
            self.register_buffer(name.replace(".", "_"), value.detach().clone(), persistent=False)
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)

    def forward(self, image: Tensor, truth: Tensor) -> Tensor:
        """Return the distances [n] of images [n, 3, h, w], sRGB-encoded in [0, 1].

        Raises:
            ValueError: shapes differ, or the images are too small for the network (31 for alex, 16 for vgg).
        """
        self._require_pair(image, truth)
        ours, theirs = self._features(image), self._features(truth)
        total = image.new_zeros(len(image))
        for level, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            squared = (_unit(a) - _unit(b)) ** 2
            total = total + conv2d(squared, self.get_buffer(f"linear_{level}")).mean(dim=(1, 2, 3))
        return total

    @torch.no_grad()
    def in_strips(self, image: Tensor, truth: Tensor, rows: int) -> Tensor:
        """The same without gradients for images of any height, with the memory of a strip of them.

        Args:
            image, truth: as above.
            rows: of a strip, a multiple of 16; features are found with 176 more above and below.

        Raises:
            ValueError: as above, or rows that are no positive multiple of 16.
        """
        self._require_pair(image, truth)
        if rows < 1 or rows % 16:
            raise ValueError(f"rows: {rows} is no positive multiple of 16")
        height, levels = image.shape[2], range(len(_LEVELS[self.network]))
        sums, counts = [image.new_zeros(len(image)) for _ in levels], [0 for _ in levels]
        for top in range(0, height, rows):
            first, last = max(0, top - _HALO), min(height, top + rows + _HALO)
            ours, theirs = (self._features(x[:, :, first:last]) for x in (image, truth))
            for level, (a, b) in enumerate(zip(ours, theirs, strict=True)):
                stride = _STRIDES[self.network][level]
                begin = (top - first) // stride
                end = a.shape[2] if top + rows >= height else (top + rows - first) // stride
                squared = (_unit(a[:, :, begin:end]) - _unit(b[:, :, begin:end])) ** 2
                # A short last strip may have no row of its own at a coarse level.
                sums[level] += (squared * self.get_buffer(f"linear_{level}")).sum(dim=(1, 2, 3))
                counts[level] += squared.shape[2] * squared.shape[3]
        return torch.stack([total / count for total, count in zip(sums, counts, strict=True)]).sum(dim=0)

    def _require_pair(self, image: Tensor, truth: Tensor) -> None:
        least = LEAST[self.network]
        if image.shape != truth.shape or image.dim() != 4 or image.shape[1] != 3:
            raise ValueError(
                f"image: {tuple(image.shape)} and {tuple(truth.shape)} are not [n, 3, h, w] alike"
            )
        if min(image.shape[2:]) < least:
            raise ValueError(f"image: {tuple(image.shape[2:])} is smaller than {least}x{least}")

    def _features(self, images: Tensor) -> list[Tensor]:
        """What the network sees at the end of each level, [n, c, h', w']."""
        x, seen, index = (2 * images - 1 - self.shift) / self.scale, [], 0
        for pool, convolutions in _LEVELS[self.network]:
            x = max_pool2d(x, pool, stride=2) if pool else x
            for stride, padding in convolutions:
                kernel, bias = (self.get_buffer(f"convolution_{index}_{part}") for part in ("weight", "bias"))
                x = torch.relu(conv2d(x, kernel, bias, stride, padding))
                index += 1
            seen.append(x)
        return seen


def _unit(features: Tensor) -> Tensor:
    """Features [n, c, h, w] of length one; zero stays zero, with a zero gradient instead of the original's NaN."""
    squared = (features**2).sum(dim=1, keepdim=True)
    return features / (squared.clamp_min(FLOOR**2).sqrt() + FLOOR)
