"""The linear light of a photograph, whole at low resolution and piece by piece at full resolution.

Coverage mixes light, not sRGB values: a pixel half covered has the mean light of both sides. A photograph of
25 megapixels would take 300 MB as float32 light, so that only a reduced image is held, and full resolution is
converted where it is needed.
"""

from __future__ import annotations

import cv2
import numpy as np

from preface.capture.images import DISPLAY_WHITE
from preface.srgb import encode, light_of_levels

WORK_SIDE = 1024  # pixels: longest side of the reduced image, on which decisions are made
SAMPLES_FOR_WHITE = 2**20  # pixels that are looked at to find what white is in a float image
STRIP_PIXELS = 2**20  # at full resolution, handled at a time


class Light:
    """A photograph as linear light, RGB, 1 being white.

    Attributes:
        height, width: of the photograph, pixels.
        factor: whole number of pixels along each axis that a reduced pixel stands for.
        white: the value of a float photograph that has light one.
    """

    def __init__(self, image: np.ndarray, white: float | None = None, gain: np.ndarray | None = None):
        """Look at a photograph.

        Args:
            image: [h, w, 1, 3 or 4] of uint8, uint16, float16 or float32; alpha is left out.
            white: of another photograph that this one is compared with; its own by default.
            gain: [3], what its light is multiplied by.
        """
        self._image = image
        self.height, self.width = image.shape[:2]
        self.factor = max(1, -(-max(self.height, self.width) // WORK_SIDE))
        integer = np.issubdtype(image.dtype, np.integer)
        self.white = 1.0 if integer else _white(image) if white is None else white
        self._gain = gain

    def at(self, rows: slice | np.ndarray, columns: slice | np.ndarray) -> np.ndarray:
        """Light float32 [..., 3] of the pixels that numpy would pick with these two indices."""
        return self._of(self._image[rows, columns])

    def strips(self) -> list[slice]:
        """Rows, some at a time, in whole reduced pixels."""
        rows = max(1, STRIP_PIXELS // (self.width * self.factor)) * self.factor
        return [slice(top, min(top + rows, self.height)) for top in range(0, self.height, rows)]

    def reduced(self) -> np.ndarray:
        """Mean light [ceil(h / factor), ceil(w / factor), 3] float32; the last row and column are filled up
        with copies of the outermost pixels.
        """
        if self.factor == 1:
            return self.at(slice(None), slice(None))
        return np.concatenate([self._reduced_strip(rows) for rows in self.strips()])

    def _reduced_strip(self, rows: slice) -> np.ndarray:
        strip = self.at(rows, slice(None))
        below, right = -strip.shape[0] % self.factor, -strip.shape[1] % self.factor
        if below or right:
            strip = cv2.copyMakeBorder(strip, 0, below, 0, right, cv2.BORDER_REPLICATE)
        size = (strip.shape[1] // self.factor, strip.shape[0] // self.factor)
        return cv2.resize(strip, size, interpolation=cv2.INTER_AREA)

    def _of(self, pixels: np.ndarray) -> np.ndarray:
        colour = pixels[..., :3]
        if colour.dtype == np.uint8 and colour.ndim == 3:
            table = light_of_levels(colour.dtype)
            light = cv2.LUT(np.ascontiguousarray(colour), table)  # four times as fast as indexing
            light = light.reshape(colour.shape)
        elif np.issubdtype(colour.dtype, np.integer):
            light = light_of_levels(colour.dtype)[colour]
        else:
            light = colour.astype(np.float32)
            finite = np.isfinite(light)
            if not finite.all():  # a renderer's empty pixels are black, its overflow is white
                light = np.where(
                    finite, light, np.where(light == np.inf, np.float32(self.white), np.float32(0))
                )
            light = light / np.float32(self.white)
        light = np.repeat(light, 3, axis=-1) if light.shape[-1] == 1 else light
        return light if self._gain is None else light * self._gain

    def encode(self, light: np.ndarray) -> np.ndarray:
        """The photograph's own type for light [..., 3]: the inverse of what `at` does."""
        dtype = self._image.dtype
        if not np.issubdtype(dtype, np.integer):
            return (light * self.white).astype(dtype)
        return np.rint(encode(np.clip(light, 0, 1)) * np.iinfo(dtype).max).astype(dtype)

    def encode_display(self, light: np.ndarray) -> np.ndarray:
        """Light [..., 3] as 8-bit sRGB, which networks look at."""
        return np.rint(encode(np.clip(light, 0, 1)) * 255).astype(np.uint8)

    def quantisation(self, light: np.ndarray) -> np.ndarray:
        """Light between two levels of the photograph's type at values of light of any shape; 0 for floats."""
        dtype = self._image.dtype
        if not np.issubdtype(dtype, np.integer):
            return np.zeros_like(light)
        table = light_of_levels(dtype)
        level = np.searchsorted(table, np.clip(light, 0, 1)).clip(1, len(table) - 1)
        return table[level] - table[level - 1]


def _white(image: np.ndarray) -> float:
    """The light of a float image that is shown as white, as in `preface.capture.images.display_tones`."""
    every = max(1, int(np.sqrt(image.shape[0] * image.shape[1] / SAMPLES_FOR_WHITE)))
    sample = image[::every, ::every, :3].astype(np.float32)
    finite = sample[np.isfinite(sample)]
    white = float(np.percentile(finite, DISPLAY_WHITE)) if finite.size else 1.0
    return white if white > 1e-9 else 1.0
