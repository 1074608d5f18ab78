"""Textures from image files: decoded to linear light, reduced to pyramids, and sampled."""

from pathlib import Path

import cv2
import numpy as np

from preface.capture.images import read_image
from preface.srgb import light_of_levels


def read_texture(path: Path) -> np.ndarray:
    """Return a texture as linear RGB and alpha, ``[H, W, 4]`` float32 in 0..1; raises ImageError."""
    pixels = read_image(path)
    if pixels.dtype.kind == "f":  # EXR is linear already
        values = pixels.astype(np.float32).clip(0.0, 1.0)
        colour = values[..., :3]
    else:
        values = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
        colour = light_of_levels(pixels.dtype)[pixels[..., : 3 if pixels.shape[2] > 1 else 1]]
    alpha = values[..., 3:] if pixels.shape[2] == 4 else np.ones_like(values[..., :1])
    colour = np.broadcast_to(colour, (*colour.shape[:2], 3))
    return np.ascontiguousarray(np.concatenate([colour, alpha], axis=2), np.float32)


def pyramid(texture: np.ndarray) -> list[np.ndarray]:
    """Return a texture ``[H, W, C]`` and its successive halves, down to a few texels."""
    levels = [texture]
    while min(levels[-1].shape[:2]) > 4:
        levels.append(cv2.pyrDown(levels[-1]))
    return levels


def sample(texture: np.ndarray, place: np.ndarray, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Sample a texture ``[H, W, C]`` at columns and rows ``[P, 2]`` in 0..1, repeating it beyond its borders."""
    height, width = texture.shape[:2]
    rows = len(place) // 4096 + 1  # cv2.remap wants maps with fewer than 32,768 columns and rows
    maps = np.zeros((rows, 4096, 2), np.float32)
    maps.reshape(-1, 2)[: len(place)] = np.mod(place, 1.0) * (width, height) - 0.5
    sampled = cv2.remap(texture, maps, None, interpolation, borderMode=cv2.BORDER_WRAP)
    return sampled.reshape(rows * 4096, -1)[: len(place)]
