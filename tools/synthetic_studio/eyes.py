"""Eyeballs: a sphere with a painted sclera and iris, and the normals of a cornea for its reflections."""

from typing import NamedTuple

import numpy as np

from synthetic_studio.identity import IRIS_COLOURS, Identity
from synthetic_studio.regions import smoothstep
from synthetic_studio.strands import unit
from synthetic_studio.subdivision import triangulate

IRIS_RADIUS = 0.0059  # metres; the human iris varies little
CORNEA_RADIUS = 0.0078
RINGS, SECTORS = 48, 96


class Eyeball(NamedTuple):
    """A sphere with centre ``[3]`` and radius in metres, and the unit direction of sight ``[3]``."""

    centre: np.ndarray
    radius: float
    gaze: np.ndarray


class EyeColour(NamedTuple):
    """Random parameters of one identity's eyes: iris fibres and veins as angular waves."""

    iris: np.ndarray
    pupil: float
    fibre_waves: np.ndarray
    fibre_phases: np.ndarray


def eyeball_mesh(ball: Eyeball) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere whose pole looks along the gaze: vertices ``[V, 3]`` and triangles ``[T, 3]``."""
    polar = np.pi * (np.arange(RINGS + 1) / RINGS) ** 1.3
    azimuth = 2.0 * np.pi * np.arange(SECTORS) / SECTORS
    right, up = _frame(ball.gaze)
    ring = np.cos(azimuth)[:, None] * right + np.sin(azimuth)[:, None] * up
    directions = np.cos(polar)[:, None, None] * ball.gaze + np.sin(polar)[:, None, None] * ring
    i, j = np.meshgrid(np.arange(RINGS), np.arange(SECTORS), indexing="ij")
    after = (j + 1) % SECTORS
    quads = np.stack(
        [i * SECTORS + j, (i + 1) * SECTORS + j, (i + 1) * SECTORS + after, i * SECTORS + after], axis=-1
    )
    return ball.centre + ball.radius * directions.reshape(-1, 3), triangulate(quads.reshape(-1, 4))


def eye_colour(identity: Identity, rng: np.random.Generator) -> EyeColour:
    """Draw the pattern of the irises."""
    waves = rng.integers(6, 70, 24).astype(np.float64)
    return EyeColour(
        np.array(IRIS_COLOURS[identity.iris]), identity.pupil, waves, rng.uniform(0.0, 2 * np.pi, (2, 24))
    )


def shade_eye(colour: EyeColour, ball: Eyeball, outward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return albedo ``[P, 3]`` and reflecting normal ``[P, 3]`` at points of an eyeball.

    Args:
        colour: The eyes' pattern.
        ball: Which eye.
        outward: ``[P, 3]`` unit directions from the eyeball's centre.
    """
    _, radius, gaze = ball
    right, up = _frame(gaze)
    x, y = radius * (outward @ right), radius * (outward @ up)
    distance = np.where(outward @ gaze > 0.0, np.hypot(x, y), radius)
    share = distance / IRIS_RADIUS
    angle = np.arctan2(y, x)
    fibres = _fibres(colour, angle, share)
    collarette = np.exp(-(((share - 0.55) / 0.10) ** 2))
    iris = colour.iris * (1.0 + 0.35 * fibres + 0.35 * collarette)[:, None]
    iris = iris * (1.0 - 0.75 * smoothstep(0.80, 1.0, share))[:, None]
    iris = np.where(share[:, None] < colour.pupil, 0.004, iris)
    soft = smoothstep(colour.pupil - 0.03, colour.pupil + 0.05, share)[:, None]
    iris = soft * iris + (1.0 - soft) * 0.004
    corner = smoothstep(0.007, 0.014, np.abs(x))[:, None]
    sclera = np.array([0.62, 0.56, 0.53]) * (1.0 - corner * np.array([0.06, 0.22, 0.22]))
    edge = smoothstep(0.94, 1.08, share)[:, None]
    albedo = (1.0 - edge) * iris + edge * sclera
    bulge = np.stack([x, y], axis=1) / CORNEA_RADIUS
    height = np.sqrt(np.maximum(1e-6, 1.0 - (bulge**2).sum(axis=1, keepdims=True)))
    cornea = bulge[:, :1] * right + bulge[:, 1:] * up + height * gaze
    cover = smoothstep(1.15, 0.95, share)[:, None]
    return np.clip(albedo, 0.003, 0.8), unit(cover * cornea + (1.0 - cover) * outward)


def _fibres(colour: EyeColour, angle: np.ndarray, share: np.ndarray) -> np.ndarray:
    pattern = np.zeros_like(angle)
    for wave, first, second in zip(colour.fibre_waves, *colour.fibre_phases, strict=True):
        pattern += np.cos(wave * angle + first + 1.5 * np.sin(4.0 * share + second))
    return pattern / np.sqrt(len(colour.fibre_waves) / 2.0)


def _frame(gaze: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    right = unit(np.cross([0.0, 1.0, 0.0], gaze))
    return right, np.cross(gaze, right)
