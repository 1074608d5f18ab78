"""A drawn person of known coverage before any background: the truth that masks are held against."""

import cv2
import numpy as np

SUPERSAMPLING = 6
SKIN, HAIR, SHIRT = (0.45, 0.26, 0.18), (0.05, 0.03, 0.02), (0.08, 0.1, 0.3)
GREEN = np.array([0.05, 0.35, 0.08])


def person(height=240, width=160, shirt=SHIRT, hair=HAIR, seed=0):
    """Coverage [h, w] and light [h, w, 3] of a head with strands of hair, cut off at the bottom."""
    scale = SUPERSAMPLING
    unit = height * scale / 240
    label = np.zeros((height * scale, width * scale), np.uint8)

    def at(x, y):
        return int(x * width * scale), int(y * height * scale)

    cv2.ellipse(label, at(0.5, 1.02), (int(62 * unit), int(66 * unit)), 0, 0, 360, 3, -1)
    cv2.ellipse(label, at(0.5, 0.42), (int(44 * unit), int(56 * unit)), 0, 0, 360, 2, -1)
    rng = np.random.default_rng(seed)
    for angle in np.linspace(200, 340, 22):
        end = np.deg2rad(angle + rng.uniform(-6, 6))
        length = unit * rng.uniform(62, 72)
        tip = np.array(at(0.5, 0.42)) + length * np.array([np.cos(end), np.sin(end) * 1.2])
        cv2.line(label, at(0.5, 0.42), tuple(int(v) for v in tip), 2, max(1, int(1.5 * unit)))
    cv2.ellipse(label, at(0.5, 0.5), (int(38 * unit), int(52 * unit)), 0, 0, 360, 1, -1)
    palette = np.array([(0, 0, 0), SKIN, hair, shirt], np.float32)
    fine = palette[label]
    area = {"dsize": (width, height), "interpolation": cv2.INTER_AREA}
    alpha = cv2.resize((label > 0).astype(np.float32), **area)
    light = cv2.resize(fine, **area) / np.maximum(alpha, 1e-6)[..., None]
    shade = (
        1 + 0.15 * cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), 2) * 5
    )
    return alpha, light * np.clip(shade, 0.6, 1.4)[..., None]


def screen(height, width, unevenness, colour=GREEN):
    """A background whose light falls off towards one corner, [h, w, 3]."""
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    return (colour * (1 + unevenness * (0.6 * x + 0.4 * y - 0.3 * x * x))[..., None]).astype(np.float32)


def photograph(alpha, light, background, dtype=np.uint8, noise=0.002, seed=1):
    """The mixture of both in linear light, with noise, in a file's type: integers sRGB-encoded, floats linear."""
    mixed = alpha[..., None] * light + (1 - alpha[..., None]) * background
    mixed = mixed + noise * np.sqrt(np.maximum(mixed, 0.01)) * np.random.default_rng(seed).standard_normal(
        mixed.shape
    )
    if np.issubdtype(dtype, np.floating):
        return mixed.astype(dtype)
    mixed = np.clip(mixed, 0, 1)
    encoded = np.where(mixed <= 0.0031308, 12.92 * mixed, 1.055 * mixed ** (1 / 2.4) - 0.055)
    return np.rint(encoded * np.iinfo(dtype).max).astype(dtype)


def iou(alpha, truth):
    """Of the two cut at one half."""
    found, true = alpha >= 0.5, truth >= 0.5
    return (found & true).sum() / max((found | true).sum(), 1)
