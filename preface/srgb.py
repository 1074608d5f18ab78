"""sRGB and the light that it encodes (IEC 61966-2-1, the exact piecewise curve)."""

from functools import cache

import numpy as np


def encode(light: np.ndarray) -> np.ndarray:
    """The sRGB values in [0, 1] of linear light in [0, 1], in the same precision."""
    power = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, light * 12.92, power).astype(light.dtype)


def decode(encoded: np.ndarray) -> np.ndarray:
    """The linear light of sRGB values in [0, 1], in the same precision."""
    power = ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, encoded / 12.92, power).astype(encoded.dtype)


@cache
def light_of_levels(dtype: np.dtype) -> np.ndarray:
    """The linear light, float32 in [0, 1], of every sRGB level of an unsigned integer type; read-only."""
    top = np.iinfo(dtype).max
    light = decode(np.arange(top + 1, dtype=np.float32) / top)
    light.setflags(write=False)
    return light
