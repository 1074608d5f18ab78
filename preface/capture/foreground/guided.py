"""A mask of low resolution brought to full resolution along the edges of the photograph.

The guided filter (He et al. 2013, Guided Image Filtering, equations 14 to 16, colour guide) models coverage as a linear
function of colour within every window; its coefficients are found on the reduced image and applied to full-resolution
colours (He and Sun 2015, Fast Guided Filter). Only the band in which the mask is undecided is computed.
"""

from __future__ import annotations

import cv2
import numpy as np

from preface.capture.foreground.fields import dilated, sample_field
from preface.capture.foreground.light import Light

UNDECIDED = (0.02, 0.98)
BAND = 3.0  # reduced pixels around the undecided ones
STRETCH = (0.05, 0.95)  # of what the filter gives: its tails are haze, not hair


def refine(light: Light, coarse: np.ndarray, radius: int, regularisation: float) -> np.ndarray:
    """Coverage at full resolution.

    Args:
        light: the photograph.
        coarse: float32 [lh, lw] in [0, 1], on its reduced image.
        radius: of the windows, reduced pixels.
        regularisation: variance of a guide's value in [0, 1] (sRGB-like tones) that counts as an edge.

    Returns:
        float32 [h, w] in [0, 1].
    """
    guide = tones(light.reduced())
    slope, offset = guided_coefficients(guide, coarse, radius, regularisation)
    coefficients = np.concatenate([slope, offset[..., None]], axis=-1)
    factor = light.factor
    band = dilated((coarse > UNDECIDED[0]) & (coarse < UNDECIDED[1]), max(BAND, radius))
    alpha = np.empty((light.height, light.width), np.float32)
    low, high = STRETCH
    for rows in light.strips():
        reduced = slice(rows.start // factor, -(-rows.stop // factor))
        height = rows.stop - rows.start
        for_all = (coarse[reduced] >= 0.5).astype(np.float32), band[reduced]
        sure, wanted = (
            np.repeat(np.repeat(m, factor, 0), factor, 1)[:height, : light.width] for m in for_all
        )
        alpha[rows] = sure
        down, across = np.nonzero(wanted)
        if len(down):
            down = down + rows.start
            fitted = sample_field(coefficients, down, across, factor)
            value = np.einsum("nc,nc->n", fitted[:, :3], tones(light.at(down, across))) + fitted[:, 3]
            alpha[down, across] = np.clip((value - low) / (high - low), 0, 1)
    return alpha


def tones(light: np.ndarray) -> np.ndarray:
    """Light as evenly spread tones in [0, 1]: dark hair's edges count as much as bright skin's."""
    return np.sqrt(np.clip(light, 0, 1))


def guided_coefficients(
    guide: np.ndarray, target: np.ndarray, radius: int, regularisation: float
) -> tuple[np.ndarray, np.ndarray]:
    """The guided filter's averaged coefficients: coverage = slope . guide + offset.

    Args:
        guide: float32 [h, w, 3].
        target: float32 [h, w].
        radius: of the square windows, pixels.
        regularisation: epsilon.

    Returns:
        slope float32 [h, w, 3], offset float32 [h, w].
    """

    def mean(field: np.ndarray) -> np.ndarray:
        side = 2 * radius + 1
        return cv2.boxFilter(field, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REFLECT_101)

    centre, average = mean(guide), mean(target)
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    covariance = np.empty((*target.shape, 3, 3), np.float32)
    for i, j in pairs:
        moment = mean(guide[..., i] * guide[..., j]) - centre[..., i] * centre[..., j]
        covariance[..., i, j] = covariance[..., j, i] = moment
    covariance += regularisation * np.eye(3, dtype=np.float32)
    cross = mean(guide * target[..., None]) - centre * average[..., None]
    slope = np.linalg.solve(covariance, cross[..., None])[..., 0]
    offset = average - np.einsum("hwc,hwc->hw", slope, centre)
    return mean(slope), mean(offset)
