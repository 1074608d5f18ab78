"""What each pixel of a smaller image takes from the pixels of a larger one, along one axis.

An axis is resampled by a banded matrix: row i holds the weights of result pixel i, which add up to 1. With
r = length / n source pixels per result pixel, c = start + (i + 1/2) r the centre of result pixel i, and p + 1/2
that of source pixel p:

- area: weight = the part of [start + i r, start + (i + 1) r) that pixel p covers, over r. Exact for any r >= 1.
- lanczos: sinc(t) sinc(t / 3), t = (p + 1/2 - c) / r, |t| < 3, over the sum of the weights inside the image
  (Duchon 1979, widened by r so that it does not alias).
- bilinear: between the two pixel centres that enclose c; at borders the last pixel.
"""

from dataclasses import dataclass

import numpy as np

from preface.capture.preparation.options import Filter

_LOBES = 3


@dataclass(frozen=True, eq=False)
class Axis:
    """A resampled axis.

    Attributes:
        first: int64 [n], the first source pixel of each result pixel; it never decreases.
        weights: float64 [n, k] of the k source pixels from there on; zero past the last one.
        length: of the source.
    """

    first: np.ndarray
    weights: np.ndarray
    length: int

    @property
    def count(self) -> int:
        """Result pixels."""
        return len(self.first)

    def compact(self) -> tuple[slice | np.ndarray, "Axis"]:
        """The source pixels that are taken from, and the axis over those alone."""
        source = self.first[:, None] + np.arange(self.weights.shape[1])
        used = np.unique(source[source < self.length])
        low, high = int(used[0]), int(used[-1]) + 1
        if 2 * len(used) > high - low:  # most of them: a copy of the used ones does not pay
            return slice(low, high), Axis(self.first - low, self.weights, high - low)
        return used, Axis(np.searchsorted(used, self.first), self.weights, len(used))

    def block(self, begin: int, end: int) -> tuple[int, int, np.ndarray]:
        """The source pixels low to high that result pixels begin to end take from, and their weights.

        Returns:
            low, high, float32 [end - begin, high - low].
        """
        taps = self.weights.shape[1]
        low = int(self.first[begin])
        high = min(int(self.first[end - 1]) + taps, self.length)
        matrix = np.zeros((end - begin, int(self.first[end - 1]) + taps - low))
        rows = np.arange(end - begin)[:, None]
        matrix[rows, (self.first[begin:end] - low)[:, None] + np.arange(taps)] = self.weights[begin:end]
        return low, high, matrix[:, : high - low].astype(np.float32)


def axis(filter: Filter, length: int, start: float, span: float, count: int) -> Axis:
    """Resample [start, start + span) of a line of ``length`` pixels to ``count`` of them.

    Args:
        filter: see the header.
        length: of the source, pixels.
        start, span: the part of it that becomes the result, in continuous pixel coordinates, inside it.
        count: of result pixels, at most ``span``.
    """
    ratio = span / count
    edges = start + np.arange(count + 1) * ratio
    centers = (edges[:-1] + edges[1:]) / 2
    if filter == "bilinear":
        first = np.clip(np.floor(centers - 0.5), 0, max(length - 2, 0)).astype(np.int64)
        second = np.clip(centers - 0.5 - first, 0, 1)
        return Axis(first, np.stack([1 - second, second], axis=1)[:, : min(length, 2)], length)
    reach = ratio / 2 if filter == "area" else _LOBES * ratio
    first = np.clip(np.floor(centers - reach), 0, length - 1).astype(np.int64)
    taps = int((np.ceil(centers + reach) - first).max())
    source = first[:, None] + np.arange(taps)
    if filter == "area":
        weights = np.minimum(source + 1, edges[1:, None]) - np.maximum(source, edges[:-1, None])
    else:
        place = (source + 0.5 - centers[:, None]) / ratio
        weights = np.where(np.abs(place) < _LOBES, np.sinc(place) * np.sinc(place / _LOBES), 0.0)
    weights = np.where(source < length, weights, 0.0)
    if filter == "area":
        weights = np.maximum(weights, 0.0)
    return Axis(first, weights / weights.sum(1, keepdims=True), length)
