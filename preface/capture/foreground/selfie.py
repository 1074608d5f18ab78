"""Any background: MediaPipe's selfie segmentation, at several scales, refined along the photograph's edges.

The model sees 256 x 256 pixels. It looks at the whole photograph first, then at a crop around the person that it found,
then at overlapping parts of that crop; finer looks decide details, coarser ones what is person at all.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from preface.capture.foreground.fields import large_components
from preface.capture.foreground.guided import refine
from preface.capture.foreground.light import Light
from preface.capture.foreground.result import Foreground, ForegroundError, Hints, checked_image

MARGIN = 0.12  # of the person's box, around it
PART = 0.6  # of the crop's sides: size of the parts that are looked at last
SMALLEST_PART = 0.05  # of the person's area
RADIUS = 0.006  # of the reduced image's longer side: windows of the guided filter
REGULARISATION = 1e-4


class Selfie:
    """MediaPipe's selfie segmentation (mediapipe 0.10.21, its general model)."""

    name = "selfie"

    def __init__(self) -> None:
        """Load the model.

        Raises:
            ForegroundError: mediapipe is not installed.
        """
        try:
            import mediapipe
        except ImportError as error:
            remedy = "Install it as tools/setup.sh does, or choose another method"
            raise ForegroundError("mediapipe", "package", f"cannot be imported ({error})", remedy) from error
        self._model: Any = mediapipe.solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)

    def __call__(self, pixels: np.ndarray, hints: Hints) -> Foreground:
        """See `Segmenter`."""
        image = checked_image(pixels, hints)
        light = Light(image)
        coarse = self._coarse(_shown(light))
        if coarse is None:
            note = "no person is seen"
            return Foreground(np.zeros(image.shape[:2], np.float32), image, self.name, (note,))
        radius = max(2, round(RADIUS * max(coarse.shape)))
        return Foreground(refine(light, coarse, radius, REGULARISATION), image, self.name)

    def _coarse(self, shown: np.ndarray) -> np.ndarray | None:
        """The model's mask on the reduced photograph, float32 [lh, lw]; None when there is nobody."""
        whole = self._look(shown)
        if float(whole.max()) < 0.5:
            return None
        top, bottom, left, right = _box_of(whole)
        crop = self._look(shown[top:bottom, left:right])
        total, weight = whole.copy(), np.ones_like(whole)
        total[top:bottom, left:right] += 2 * crop
        weight[top:bottom, left:right] += 2
        for rows, columns in _parts(top, bottom, left, right):
            look, taper = self._look(shown[rows, columns]), _taper(rows, columns)
            total[rows, columns] += 3 * taper * look
            weight[rows, columns] += 3 * taper
        mask = total / weight
        kept = large_components(mask > 0.5, SMALLEST_PART, 0.02 * max(mask.shape))
        return np.where(kept | (mask <= 0.5), mask, 0).astype(np.float32)

    def _look(self, crop: np.ndarray) -> np.ndarray:
        """The model's answer for one crop, uint8 RGB [h, w, 3]: float32 [h, w]."""
        return np.array(self._model.process(np.ascontiguousarray(crop)).segmentation_mask, np.float32)


def _shown(light: Light) -> np.ndarray:
    """The reduced photograph as the model looks at it, uint8 RGB."""
    return light.encode_display(light.reduced())


def _box_of(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Rows and columns around the person, with a margin: top, bottom, left, right."""
    rows, columns = (np.flatnonzero((mask > 0.5).any(axis=axis)) for axis in (1, 0))
    margin = MARGIN * max(int(rows[-1] - rows[0]), int(columns[-1] - columns[0]), 1)
    top, left = (max(0, int(edge.min() - margin)) for edge in (rows, columns))
    bottom, right = (
        min(side, int(edge.max() + margin) + 1)
        for edge, side in ((rows, mask.shape[0]), (columns, mask.shape[1]))
    )
    return top, bottom, left, right


def _parts(top: int, bottom: int, left: int, right: int) -> list[tuple[slice, slice]]:
    """The four overlapping quarters of a crop."""
    height, width = bottom - top, right - left
    tall, wide = int(PART * height), int(PART * width)
    if min(tall, wide) < 64:
        return []  # no finer than what has been looked at
    return [
        (slice(y, y + tall), slice(x, x + wide)) for y in (top, bottom - tall) for x in (left, right - wide)
    ]


def _taper(rows: slice, columns: slice) -> np.ndarray:
    """A weight that falls to zero towards a part's border, where the model does not see what follows."""
    window = np.outer(
        np.hanning(rows.stop - rows.start + 2)[1:-1], np.hanning(columns.stop - columns.start + 2)[1:-1]
    )
    return cv2.sqrt(window.astype(np.float32))
