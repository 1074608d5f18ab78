"""The studio's light: a uniform surround, a large soft key and a weaker fill, baked by ray casting.

Every light is a set of directions with a radiance weight, so that shadows are soft and free of noise.
The result is independent of the view and is computed once per identity.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import open3d as o3d

KEY_DIRECTION = np.array([0.42, 0.62, 0.66])
FILL_DIRECTION = np.array([-0.75, 0.10, 0.65])
HAIR_EXTINCTION = 0.8  # optical thickness of one shadow caster, which stands for several strands


@dataclass(frozen=True)
class Lights:
    """Directions towards the light ``[D, 3]``, their irradiance weights ``[D]``, and which belong to the key."""

    directions: np.ndarray
    weights: np.ndarray
    is_key: np.ndarray


@cache
def studio_lights() -> Lights:
    """Return the lights, scaled so that a white surface that faces the camera has radiance of about 0.9."""
    surround = _fibonacci_sphere(64)
    # The floor is darker than walls and ceiling.
    surround_weights = np.where(surround[:, 1] < -0.3, 0.35, 1.0) * (0.62 * 4.0 / len(surround))
    key = _panel(KEY_DIRECTION, half_angle=0.36, count=5)
    fill = _panel(FILL_DIRECTION, half_angle=0.30, count=3)
    return Lights(
        directions=np.concatenate([surround, key, fill]),
        weights=np.concatenate(
            [surround_weights, np.full(len(key), 0.50 / len(key)), np.full(len(fill), 0.12 / len(fill))]
        ),
        is_key=np.concatenate(
            [np.zeros(len(surround), bool), np.ones(len(key), bool), np.zeros(len(fill), bool)]
        ),
    )


@dataclass(frozen=True)
class Occluders:
    """What casts shadows: the solid head, and hair that lets part of the light through."""

    solid: o3d.t.geometry.RaycastingScene
    hair: o3d.t.geometry.RaycastingScene | None

    def transmittance(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the share of light ``[R]`` that reaches ``origins`` ``[R, 3]`` from unit ``directions`` ``[R, 3]``."""
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        visible = 1.0 - self.solid.test_occlusions(rays, tnear=1e-4, nthreads=1).numpy()
        if self.hair is not None:
            open_rays = np.flatnonzero(visible)
            strands = self.hair.count_intersections(rays[open_rays], nthreads=1).numpy()
            visible[open_rays] = np.exp(-HAIR_EXTINCTION * strands)
        return visible


@dataclass(frozen=True)
class BakedLight:
    """Per vertex: irradiance over pi from all lights, and the unshadowed share of the key and of the surround."""

    irradiance: np.ndarray
    key_visibility: np.ndarray
    openness: np.ndarray


def bake_surface(vertices: np.ndarray, normals: np.ndarray, occluders: Occluders) -> BakedLight:
    """Gather the light at surface points.

    Args:
        vertices: ``[V, 3]`` metres.
        normals: ``[V, 3]`` unit outward normals.
        occluders: What casts shadows.
    """
    lights = studio_lights()
    cosine = normals @ lights.directions.T  # [V, D]
    transmitted = np.zeros_like(cosine)
    point, light = np.nonzero(cosine > 0.0)
    origins = vertices[point] + 8e-4 * normals[point]
    transmitted[point, light] = occluders.transmittance(origins, lights.directions[light])
    facing = np.maximum(cosine, 0.0)
    return BakedLight(
        irradiance=(facing * transmitted) @ lights.weights,
        key_visibility=_mean_over(transmitted, facing, lights.is_key),
        openness=_mean_over(transmitted, facing, ~lights.is_key),
    )


def bake_strands(points: np.ndarray, tangents: np.ndarray, occluders: Occluders) -> np.ndarray:
    """Gather the light ``[P]`` at points of thin fibres, with the cylinder's sine law (Kajiya and Kay, 1989)."""
    lights = studio_lights()
    used = np.flatnonzero(np.arange(len(lights.weights)) % 2 == 0)
    directions = lights.directions[used]
    scale = lights.weights.sum() / lights.weights[used].sum()
    origins = np.repeat(points, len(used), axis=0)
    transmitted = occluders.transmittance(origins, np.tile(directions, (len(points), 1))).reshape(
        len(points), -1
    )
    sine = np.sqrt(np.maximum(0.0, 1.0 - (tangents @ directions.T) ** 2))
    # A fibre lit from all around receives four times the facing surface's share; 0.5 brings both in line.
    return 0.5 * scale * (sine * transmitted) @ lights.weights[used]


def _mean_over(values: np.ndarray, weights: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    return (values * weights)[:, chosen].sum(axis=1) / np.maximum(weights[:, chosen].sum(axis=1), 1e-9)


def _fibonacci_sphere(count: int) -> np.ndarray:
    k = np.arange(count) + 0.5
    y = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - y * y)
    return np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=1)


def _panel(direction: np.ndarray, half_angle: float, count: int) -> np.ndarray:
    """Return ``count**2`` unit directions spread over a square softbox."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    up = np.cross(forward, right)
    offsets = np.tan(half_angle) * (2.0 * (np.arange(count) + 0.5) / count - 1.0)
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(offsets, offsets))
    panel = forward + u * right + v * up
    return panel / np.linalg.norm(panel, axis=1, keepdims=True)
