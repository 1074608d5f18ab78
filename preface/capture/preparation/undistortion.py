"""Resampling a distorting lens away, between two halves of the downscale and never after it.

    photograph -> light -> area / reduction -> remap to a fine pinhole image -> filter to the result

The fine pinhole image has several pixels per result pixel, so that what the remap's kernel blurs is averaged
anyway. The pinhole keeps the window's focal lengths and principal point. Where it looks past the photograph's
border, or to where the lens folds, there is no picture: such fine pixels count neither for colours nor for
coverage.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from preface.capture.preparation.filters import Axis, axis
from preface.capture.preparation.options import Filter, PreparationError
from preface.capture.preparation.places import Places
from preface.capture.preparation.separable import Separable
from preface.capture.preparation.transfer import Reader, as_they_are
from preface.geometry import Camera
from preface.geometry.conventions import pixels_to_opencv

# Result rows made in one go: source rows are read twice where the curved borders of two bands overlap.
_BAND = 64
_REACH = 5  # rows beyond its place that a kernel of `cv2.remap` takes from, and one for rounding
_READ_ROWS = 16
_REMAP_LIMIT = 2**15 - 1  # pixels per side that `cv2.remap` can address
# Source pixels per result pixel from which on the photograph is halved first: what the bench shows to cost less
# than it gives.
_HALVED_FROM = 4.0


@dataclass(frozen=True)
class Route:
    """How finely the photograph is resampled.

    Attributes:
        reduction: by area, in whole pixels, before the remap.
        across, down: fine pixels per result pixel.
        kernel: of the remap: linear, cubic or lanczos4.
    """

    reduction: int
    across: int
    down: int
    kernel: str

    @classmethod
    def usual(cls, filter: Filter, ratio_across: float, ratio_down: float) -> Route:
        """The route for so many source pixels per result pixel."""
        if filter == "bilinear":
            return cls(1, 1, 1, "linear")
        halved = min(ratio_across, ratio_down) >= _HALVED_FROM
        across, down = (max(1, round(ratio / (2 if halved else 1))) for ratio in (ratio_across, ratio_down))
        # Averaging many fine pixels makes up for a linear kernel's blur, averaging few does not.
        return cls(2, across, down, "linear") if halved else cls(1, across, down, "cubic")


class _Band(NamedTuple):
    """Result rows begin to end, which ``filter`` makes of the fine rows low to high."""

    begin: int
    end: int
    low: int
    high: int
    filter: Separable


class Pinhole:
    """Resamples photographs of one distorting lens to a pinhole image; planned once, applied to many.

    Attributes:
        covered: whether all of the result shows the photograph.
    """

    def __init__(self, source: Camera, pinhole: Camera, filter: Filter, route: Route):
        """Plan the resampling.

        Args:
            source: the camera of the photographs.
            pinhole: the camera of the result.
            filter: from the fine pinhole image to the result.
            route: how fine that is.

        Raises:
            PreparationError: the photograph is wider or higher than OpenCV can remap.
        """
        self._route, self._source = route, source
        self._size = (pinhole.height, pinhole.width)
        fine = pinhole.resized(pinhole.width * route.across, pinhole.height * route.down)
        if max(fine.width, source.width / route.reduction) > _REMAP_LIMIT:
            problem = f"cannot be resampled at {source.width}x{source.height} pixels: OpenCV's limit is 32767"
            raise PreparationError(
                "undistort", problem, "keep the distortion, or halve the photographs first"
            )
        self._places = Places(source, fine)
        self.covered = self._places.covered
        down = axis(filter, fine.height, 0.0, fine.height, pinhole.height)
        across = axis(filter, fine.width, 0.0, fine.width, pinhole.width)
        self._bands = [_band(down, across, begin) for begin in range(0, pinhole.height, _BAND)]

    def __call__(self, read: Reader, *sources: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Resample a photograph.

        Args:
            read: turns rows, one array of them per source, into float32.
            sources: [h, w, c] of any type that ``read`` reads; the first one has the channels of what is read.

        Returns:
            float32 [H, W, c], the sum over what a pixel shows of the photograph; and float32 [H, W, 1], the
            share of the pixel that shows it, None where all of all pixels does.
        """
        sums = np.empty((*self._size, sources[0].shape[2]), np.float32)
        shares = None if self.covered else np.empty((*self._size, 1), np.float32)
        for band in self._bands:
            x, y, valid = self._places.rows(band.low, band.high)
            fine = self._remapped(sources, read, x, y, valid)
            sums[band.begin : band.end] = band.filter(as_they_are, fine)
            if shares is not None:
                weight = np.ones((*x.shape, 1), np.float32) if valid is None else valid[..., None]
                shares[band.begin : band.end] = band.filter(as_they_are, weight.astype(np.float32))
        return sums, shares

    def _remapped(
        self,
        sources: tuple[np.ndarray, ...],
        read: Reader,
        x: np.ndarray,
        y: np.ndarray,
        valid: np.ndarray | None,
    ) -> np.ndarray:
        """The photograph at places [n, m], float32 [n, m, c]; 0 where they are not valid."""
        import cv2

        channels = sources[0].shape[2]
        seen = y if valid is None else y[valid]
        if not seen.size:
            return np.zeros((*x.shape, channels), np.float32)
        reduction = self._route.reduction
        most = -(-self._source.height // reduction)
        low = max(0, int(seen.min() / reduction) - _REACH)
        high = min(most, int(seen.max() / reduction) + 1 + _REACH)
        part = _reduced(sources, read, reduction, low, high)
        kernel = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos4": cv2.INTER_LANCZOS4}
        scale = np.float32(1 / reduction)
        fine = cv2.remap(
            part,
            pixels_to_opencv(x * scale),
            pixels_to_opencv(y * scale - np.float32(low)),
            kernel[self._route.kernel],
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(*x.shape, channels)
        if valid is not None:
            fine *= valid[..., None]
        return fine


def _band(down: Axis, across: Axis, begin: int) -> _Band:
    end = min(begin + _BAND, down.count)
    low, high, _ = down.block(begin, end)
    rows = Axis(down.first[begin:end] - low, down.weights[begin:end], high - low)
    return _Band(begin, end, low, high, Separable(rows, across))


def _reduced(
    sources: tuple[np.ndarray, ...], read: Reader, reduction: int, low: int, high: int
) -> np.ndarray:
    """Rows low to high of the photograph reduced by area, float32 [high - low, w / reduction rounded up, c].

    The last row and column stand in for those that a reduction past the border lacks.
    """
    import cv2

    width, channels = sources[0].shape[1:]
    columns = -(-width // reduction)
    part = np.empty((high - low, columns, channels), np.float32)
    light = np.empty((_READ_ROWS * reduction, columns * reduction, channels), np.float32)
    for begin in range(low, high, _READ_ROWS):
        end = min(begin + _READ_ROWS, high)
        rows = light[: (end - begin) * reduction]
        there = [source[begin * reduction : end * reduction] for source in sources]
        count = len(there[0])
        read(*there, rows[:count, :width])
        rows[:count, width:] = rows[:count, width - 1 : width]
        rows[count:] = rows[count - 1]
        into = part[begin - low : end - low]
        if reduction == 1:
            into[...] = rows
        else:
            flat = into if channels > 1 else into[..., 0]  # OpenCV drops a single channel
            cv2.resize(rows, (columns, end - begin), dst=flat, interpolation=cv2.INTER_AREA)
    return part
