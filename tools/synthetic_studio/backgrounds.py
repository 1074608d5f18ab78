"""What stands behind the people: nothing, or a green screen that is not perfectly even."""

from __future__ import annotations

from typing import Literal

import numpy as np

from preface.geometry.cameras import Camera
from synthetic_studio.config import StudioConfig
from synthetic_studio.streams import Stream, generator

# Linear RGB of chroma-key cloth under studio light.
GREEN = np.array([0.05, 0.35, 0.08], np.float32)
# Largest relative deviation of the illumination of the screen from its mean.
UNEVENNESS = 0.25

Backdrop = Literal["black", "green"]


def backdrop(config: StudioConfig, take: int) -> Backdrop:
    """The backdrop of a take; a lab that changes has black first and green in the second half of them."""
    if config.background != "changing":
        return config.background
    return "black" if 2 * take < max(config.takes, 2) else "green"


def background_radiance(
    kind: Backdrop, camera: Camera, seed: int, take: int, camera_index: int
) -> np.ndarray:
    """Linear light of the backdrop as one camera sees it in one take.

    Returns [H, W, 3] float32. The green screen's illumination is a smooth quadratic over the image, drawn per
    take and camera and defined in fractions of the image, so it looks the same at any resolution.
    """
    if kind == "black":
        return np.zeros((camera.height, camera.width, 3), np.float32)
    x = 2 * (np.arange(camera.width) + 0.5)[None, :] / camera.width - 1
    y = 2 * (np.arange(camera.height) + 0.5)[:, None] / camera.height - 1
    weights = generator(seed, Stream.GREEN_SCREEN, take, camera_index).uniform(-1, 1, 5) / 5
    waviness = weights[0] * x + weights[1] * y + weights[2] * x * y + weights[3] * x**2 + weights[4] * y**2
    return ((1 + UNEVENNESS * waviness)[..., None] * GREEN).astype(np.float32)


def composite(radiance: np.ndarray, alpha: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Premultiplied radiance [H, W, 3] with coverage alpha [H, W] over a background [H, W, 3], all linear."""
    return radiance + (1 - alpha)[..., None] * background
