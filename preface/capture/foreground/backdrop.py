"""What stands behind the person, as the border of a photograph shows it."""

from __future__ import annotations

import numpy as np

from preface.capture.foreground.fields import SAMPLES, quadratic_field
from preface.capture.foreground.light import Light
from preface.capture.foreground.result import Hints, checked_image

BORDER_SHARE = 0.02  # of the shorter side: how wide a border is looked at
BLACK_LIGHT = 0.008  # sRGB 23: what black cloth may reflect
GREENNESS = 1.35  # green light over the larger of red and blue: of a chroma-key screen, not of a grey wall
LEAST_GREEN = 0.03  # light; below it a ratio of channels is noise
LEAST_SHARE = 0.4  # of the border; the person may cover the rest


def border(height: int, width: int) -> np.ndarray:
    """The top, left and right border, bool [h, w]. The bottom is where bodies are cut off."""
    wide = max(1, round(BORDER_SHARE * min(height, width)))
    ring = np.zeros((height, width), bool)
    ring[:wide] = True
    ring[:, :wide] = True
    ring[:, -wide:] = True
    return ring


def is_green(light: np.ndarray) -> np.ndarray:
    """Whether light [..., 3] is that of a green screen: bool [...]."""
    green = light[..., 1]
    return (green > LEAST_GREEN) & (green > GREENNESS * np.maximum(light[..., 0], light[..., 2]))


def is_black(light: np.ndarray) -> np.ndarray:
    """Whether light [..., 3] is no brighter than black cloth: bool [...]."""
    return light.max(axis=-1) < BLACK_LIGHT


def border_kind(pixels: np.ndarray) -> str:
    """What the border of a photograph shows: "black", "green" or "natural".

    Args:
        pixels: as `Segmenter` takes them.
    """
    light = Light(checked_image(pixels, Hints())).reduced()
    ring = light[border(*light.shape[:2])]
    shares = {"black": float(is_black(ring).mean()), "green": float(is_green(ring).mean())}
    kind = max(shares, key=lambda name: shares[name])
    return kind if shares[kind] >= LEAST_SHARE else "natural"


def noise_of(light: np.ndarray, field: np.ndarray, known: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Standard deviation float32 [3] of light about a field where the background is known (MAD), and no less
    than a floor [3].
    """
    places = np.flatnonzero(known)[:: max(1, int(known.sum()) // SAMPLES)]
    if len(places):
        residual = light.reshape(-1, 3)[places] - field.reshape(-1, 3)[places]
        spread = 1.4826 * np.median(np.abs(residual), axis=0)
        return np.maximum(spread, floor).astype(np.float32)
    return floor.astype(np.float32)


def smooth_background(light: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The slowly varying light of a backdrop, float32 [h, w, 3], from the pixels that are known to show it."""
    return quadratic_field(light, known)
