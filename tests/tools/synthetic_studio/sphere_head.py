"""A stand-in for a head, with known truth: a coloured sphere, ray-cast analytically."""

from dataclasses import dataclass

import numpy as np

CENTRE = np.array([0.0, 0.02, -0.07])


@dataclass
class SphereRender:
    radiance: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    normals: np.ndarray


class Subject:
    def __init__(self, seed, index, assets):
        random = np.random.default_rng([seed, index])
        self.index = index
        self.radius = random.uniform(0.09, 0.12)
        self.colour = random.uniform(0.2, 0.8, 3)
        front = CENTRE + np.array([0, 0, self.radius])
        self.parameters = {"radius": self.radius}
        self.keypoints = {"nose_tip": front}
        self.landmarks = {"1": front, "chin": front - np.array([0, 0.01, 0])}

    def render(self, camera, camera_from_studio, antialias):
        steps = (np.arange(antialias) + 0.5) / antialias
        u = (np.arange(camera.width)[:, None] + steps).ravel()
        v = (np.arange(camera.height)[:, None] + steps).ravel()
        rays, _ = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
        directions = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1)
        centre = camera_from_studio.apply(CENTRE)
        # |s d - c|^2 = r^2, with s the depth along z because d_z is 1.
        a, b = (directions**2).sum(-1), directions @ centre
        discriminant = b**2 - a * (centre @ centre - self.radius**2)
        hit = discriminant > 0
        depth = np.where(hit, (b - np.sqrt(np.maximum(discriminant, 0))) / a, np.nan)
        points = directions * depth[..., None]
        normals = (points - centre) / self.radius @ camera_from_studio.rotation
        alpha = _mean(hit.astype(np.float32)[..., None], antialias)[..., 0]
        light = hit[..., None] * self.colour * (0.3 + 0.7 * np.maximum(np.nan_to_num(normals)[..., 2:], 0))
        middle = antialias // 2
        every = (slice(middle, None, antialias), slice(middle, None, antialias))
        return SphereRender(
            _mean(light, antialias).astype(np.float32),
            alpha,
            depth[every].astype(np.float32),
            normals[every].astype(np.float32),
        )


def _mean(image, n):
    height, width, channels = image.shape
    return image.reshape(height // n, n, width // n, n, channels).mean(axis=(1, 3))
