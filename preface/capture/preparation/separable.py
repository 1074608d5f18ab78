"""Applying two axes to an image by small matrix products: any filter and any ratio at the speed of one.

The image is read once, a few rows at a time, which stay in the cache while they become light and are added up
into the result rows that take from them; when 32 of those are there, their columns are combined. Nothing of
the image's size is allocated, whatever the ratio.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from preface.capture.preparation.filters import Axis
from preface.capture.preparation.transfer import Reader

# Result rows whose columns are combined in one go: enough for matrix products to be worth their calls.
_BAND = 32
# Result rows per product over rows: BLAS multiplies so flat a matrix in place instead of repacking the image.
_FLAT = 2
# Result columns per product over columns: its matrix is banded, and mostly zeros where it is large.
_ACROSS = 8
# The light of the rows that are read in one go, with room for the sums in a core's second-level cache.
_STEP_BYTES = 2**20


class _Product(NamedTuple):
    """Rows begin to end of a band take ``matrix @ light[low:high]``, or that more."""

    begin: int
    end: int
    low: int
    high: int
    matrix: np.ndarray
    more: bool


class _Step(NamedTuple):
    """Source rows low to high, and what takes from them."""

    low: int
    high: int
    products: list[_Product]


class _Block(NamedTuple):
    """Numbers left to right of a result line are numbers low to high of a source line times ``matrix``."""

    low: int
    high: int
    left: int
    right: int
    matrix: np.ndarray


class _Plan(NamedTuple):
    """What is done to images of one number of channels: ``bands`` of steps of at most ``most`` source rows."""

    bands: list[list[_Step]]
    blocks: list[_Block]
    most: int


class Separable:
    """Rows and columns of images of one size combined by two axes; planned once, applied to many."""

    def __init__(self, down: Axis, across: Axis):
        """Take how rows (``down``) and columns (``across``) are combined."""
        self._rows, self._down = down.compact()
        self._columns, self._across = across.compact()
        self._plans: dict[int, _Plan] = {}

    def __call__(self, read: Reader, *sources: np.ndarray) -> np.ndarray:
        """Filter an image.

        Args:
            read: turns rows, one array of them per source, into float32; see
                `preface.capture.preparation.transfer.reader`.
            sources: [h, w, c] of any type that ``read`` reads, contiguous but for its rows' distance; the first one
                has the channels of what is read.

        Returns:
            float32 [H, W, c].
        """
        channels = sources[0].shape[2]
        height, width = self._down.count, self._across.count
        bands, blocks, most = self._plan(channels)
        lines = [_lines(_taken(_taken(source, self._rows, 0), self._columns, 1)) for source in sources]
        length = lines[0].shape[1]
        result = np.empty((height, width * channels), np.float32)
        sums = np.empty((min(_BAND, height), length), np.float32)
        light = np.empty((most, length), np.float32)
        for begin, band in zip(range(0, height, _BAND), bands, strict=True):
            for step in band:
                _add_up(lines, read, step, light, sums)
            made = min(_BAND, height - begin)
            for low, high, left, right, matrix in blocks:
                result[begin : begin + made, left:right] = sums[:made, low:high] @ matrix
        return result.reshape(height, width, channels)

    def _plan(self, channels: int) -> _Plan:
        if channels not in self._plans:
            most = max(1, _STEP_BYTES // (4 * channels * self._across.length))
            bands = [
                _steps(self._down, begin, min(begin + _BAND, self._down.count), most)
                for begin in range(0, self._down.count, _BAND)
            ]
            highest = max(step.high - step.low for band in bands for step in band)
            self._plans[channels] = _Plan(bands, _blocks(self._across, channels), highest)
        return self._plans[channels]


def _add_up(lines: list[np.ndarray], read: Reader, step: _Step, light: np.ndarray, sums: np.ndarray) -> None:
    """Read the rows of one step and add what the rows of the band take from them."""
    rows = light[: step.high - step.low]
    read(*(source[step.low : step.high] for source in lines), rows)
    for product in step.products:
        taken, into = rows[product.low : product.high], sums[product.begin : product.end]
        if product.more:
            into += product.matrix @ taken
        else:
            np.matmul(product.matrix, taken, out=into)


def _taken(source: np.ndarray, used: slice | np.ndarray, dimension: int) -> np.ndarray:
    if isinstance(used, np.ndarray):
        return np.take(source, used, axis=dimension)
    return source[used] if dimension == 0 else source[:, used]


def _lines(source: np.ndarray) -> np.ndarray:
    """The image [h, w, c] as [h, w * c] without a copy."""
    height, width, channels = source.shape
    shape, strides = (height, width * channels), (source.strides[0], source.itemsize)
    return np.lib.stride_tricks.as_strided(source, shape, strides, writeable=False)


def _steps(down: Axis, begin: int, end: int, most: int) -> list[_Step]:
    """The steps, of at most so many source rows each, that make result rows begin to end."""
    low, high, weights = down.block(begin, end)
    # Steps begin where a result row does, so that as few result rows as can be take from two steps.
    advance = max(1.0, (down.first[end - 1] - down.first[begin]) / max(1, end - 1 - begin))
    starts = down.first[begin : end : max(1, int(most // advance))] - low
    cuts = {0, high - low}
    for start, stop in zip(starts, [*starts[1:], high - low], strict=True):
        cuts.update(range(int(start), int(stop), most))
    edges = sorted(cuts)
    steps, made = [], np.zeros(end - begin, bool)
    for start, stop in pairwise(edges):
        part = weights[:, start:stop]
        takers = np.flatnonzero(part.any(1))
        products = []
        while len(takers):
            same = int((made[takers[:_FLAT]] == made[takers[0]]).sum())  # new ones follow on begun ones
            rows, takers = takers[:same], takers[same:]
            used = np.flatnonzero(part[rows[0] : rows[-1] + 1].any(0))
            first, last = int(used[0]), int(used[-1]) + 1
            matrix = np.ascontiguousarray(part[rows[0] : rows[-1] + 1, first:last])
            products.append(_Product(rows[0], rows[-1] + 1, first, last, matrix, bool(made[rows[0]])))
            made[rows] = True
        steps.append(_Step(low + start, low + stop, products))
    return steps


def _blocks(across: Axis, channels: int) -> list[_Block]:
    blocks: list[_Block] = []
    for begin in range(0, across.count, _ACROSS):
        end = min(begin + _ACROSS, across.count)
        low, high, weights = across.block(begin, end)
        matrix = np.kron(weights.T, np.eye(channels, dtype=np.float32))  # channels lie interleaved
        low, high, begin, end = (channels * column for column in (low, high, begin, end))
        blocks.append(_Block(low, high, begin, end, np.ascontiguousarray(matrix)))
    return blocks
