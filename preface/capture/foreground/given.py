"""Masks that the user has made, and no mask at all."""

from __future__ import annotations

import numpy as np

from preface.capture.foreground.result import (
    Foreground,
    ForegroundError,
    Hints,
    Segmenter,
    check_size,
    checked_image,
)


class GivenMask:
    """The user's mask as it is; without one, the alpha channel of the photograph itself."""

    name = "given"

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`."""
        image = checked_image(pixels, hints)
        if hints.mask is None and image.shape[2] == 4:
            return Foreground(coverage(image[..., 3:], hints), image, self.name, ("the image's own alpha",))
        if hints.mask is None:
            raise ForegroundError(hints.path, "mask", "is missing", "Give a mask, or choose another method")
        check_size(hints.mask, image, "mask", hints)
        return Foreground(coverage(hints.mask, hints), image, self.name)


class GivenWhereThereIsOne:
    """The user's mask for photographs that have one, and another method for those that do not."""

    def __init__(self, otherwise: Segmenter):
        self.name = otherwise.name
        self._otherwise = otherwise
        self._given = GivenMask()

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`."""
        return (self._otherwise if hints.mask is None else self._given)(pixels, hints)


class Nothing:
    """No segmentation: everything is foreground."""

    name = "none"

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`."""
        image = checked_image(pixels, hints)
        return Foreground(np.ones(image.shape[:2], np.float32), image, self.name)


def coverage(mask: np.ndarray, hints: Hints) -> np.ndarray:
    """A mask of any kind as float32 [h, w] in [0, 1].

    A mask of truth values or one with at most two levels, whatever they are, is 0 and 1. RGB masks must be grey; of
    a mask with an alpha channel that varies, the alpha channel counts.

    Raises:
        ForegroundError: a coloured mask, or floats that are not finite or lie outside [0, 1].
    """
    planes = mask[..., None] if mask.ndim == 2 else mask
    if planes.ndim != 3 or planes.shape[2] not in (1, 3, 4) or planes.size == 0:
        raise ForegroundError(hints.path, "mask", f"has the shape {mask.shape}", "Give [height, width]")
    if planes.shape[2] == 4 and np.ptp(planes[..., 3]) > 0:
        planes = planes[..., 3:]
    grey = planes[..., 0]
    if planes.shape[2] > 1 and not all(np.array_equal(grey, planes[..., c]) for c in (1, 2)):
        remedy = "Give a grey image, white where the person is"
        raise ForegroundError(hints.path, "mask", "is coloured", remedy)
    if grey.dtype == np.bool_:
        return grey.astype(np.float32)
    if np.issubdtype(grey.dtype, np.floating):
        if not (np.isfinite(grey).all() and grey.min() >= 0 and grey.max() <= 1):
            raise ForegroundError(hints.path, "mask", "has values outside [0, 1]", "Give coverage in [0, 1]")
        return grey.astype(np.float32)
    if not np.issubdtype(grey.dtype, np.unsignedinteger):
        raise ForegroundError(hints.path, "mask", f"is of type {grey.dtype}", "Give 8 or 16 bits, or floats")
    top = int(grey.max())
    if 0 < top < np.iinfo(grey.dtype).max and np.isin(grey, (0, top)).all():
        return (grey == top).astype(np.float32)  # labels 0 and 1, as many programs write masks
    return grey.astype(np.float32) / np.float32(np.iinfo(grey.dtype).max)
