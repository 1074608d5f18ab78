"""What a sensor makes of light: vignetting, blur, exposure, noise, clipping and sRGB encoding."""

from __future__ import annotations

import cv2
import numpy as np

from preface.geometry.cameras import Camera
from preface.srgb import encode
from synthetic_studio.config import SensorConfig
from synthetic_studio.streams import Stream, generator

# Rows that are noised and encoded at a time: keeps a 25-megapixel image from needing gigabytes of scratch.
BAND_ROWS = 256


def vignetting(camera: Camera, strength: float) -> np.ndarray:
    """Relative illumination [H, W] float32: cos(theta)^(4 strength), theta from the optical axis."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    x = (np.arange(camera.width) + 0.5 - cx) / fx
    y = (np.arange(camera.height) + 0.5 - cy) / fy
    squared_tangent = x[None, :] ** 2 + y[:, None] ** 2
    return ((1 + squared_tangent) ** (-2 * strength)).astype(np.float32)


def vignetting_strength(config: SensorConfig, seed: int, camera_index: int) -> float:
    """The strength of one camera's vignetting: the configured one, varied by up to 20 percent."""
    return config.vignetting * generator(seed, Stream.VIGNETTING, camera_index).uniform(0.8, 1.2)


def expose(
    radiance: np.ndarray, falloff: np.ndarray, config: SensorConfig, noise: np.random.Generator
) -> np.ndarray:
    """Photograph linear light.

    Args:
        radiance: [H, W, 3] float32 linear light, 1 is full scale at exposure 1.
        falloff: [H, W] float32 relative illumination, from `vignetting`.
        config: the sensor.
        noise: generator of this image's noise.

    Returns:
        [H, W, 3] uint8, sRGB-encoded.

    The noise is the Gaussian limit of Poisson shot noise plus read noise, its variance in electrons being
    signal + read_noise^2 (EMVA 1288 without quantisation); below some 10 electrons, where the limit fails,
    read noise dominates.
    """
    light: np.ndarray = radiance * (config.exposure * falloff)[..., None]
    if config.blur > 0:
        light = cv2.GaussianBlur(light, (0, 0), config.blur, borderType=cv2.BORDER_REPLICATE)
    image = np.empty(light.shape, np.uint8)
    for top in range(0, len(light), BAND_ROWS):
        band = light[top : top + BAND_ROWS]
        if config.full_well > 0:
            band = _add_noise(band, config, noise)
        encoded = encode(np.clip(band, 0.0, 1.0))
        image[top : top + BAND_ROWS] = (encoded * 255 + 0.5).astype(np.uint8)
    return image


def _add_noise(light: np.ndarray, config: SensorConfig, noise: np.random.Generator) -> np.ndarray:
    electrons = np.maximum(light, 0) * config.full_well
    deviation = np.sqrt(electrons + config.read_noise**2)
    noisy = electrons + deviation * noise.standard_normal(light.shape, np.float32)
    return noisy / np.float32(config.full_well)
