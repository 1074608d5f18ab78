"""Fibres of all kinds: strands as polylines, and the flat ribbons that the ray caster sees."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class Strands:
    """Fibres with the same number of points each.

    Attributes:
        points: ``[S, K, 3]`` metres, root first.
        outward: ``[S, 3]`` unit normals of the skin at the roots; ribbons face that way.
        width: ``[S]`` metres at the root; the tip tapers.
        colour: ``[S, 3]`` linear RGB albedo.
        light: ``[S, K]`` baked light along the strands.
    """

    points: np.ndarray
    outward: np.ndarray
    width: np.ndarray
    colour: np.ndarray
    light: np.ndarray

    def tangents(self) -> np.ndarray:
        """Return unit tangents ``[S, K, 3]``."""
        return unit(np.gradient(self.points, axis=1))

    def __len__(self) -> int:
        """Return the number of strands."""
        return len(self.points)


def concatenate(parts: list[Strands]) -> Strands:
    """Join strands of equal point counts."""
    return Strands(
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in Strands.__dataclass_fields__
        }
    )


def resample(points: np.ndarray, count: int) -> np.ndarray:
    """Interpolate polylines ``[S, K, 3]`` by cubic splines to ``[S, count, 3]``."""
    knots = np.arange(points.shape[1])
    return CubicSpline(knots, points, axis=1)(np.linspace(0.0, knots[-1], count))


def ribbons(strands: Strands) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices ``[S * K * 2, 3]`` and triangles ``[S * (K - 1) * 2, 3]`` of the strands' ribbons.

    Vertex ``(s * K + k) * 2 + side`` lies at point ``k`` of strand ``s``.
    """
    count, length, _ = strands.points.shape
    across = unit(np.cross(strands.tangents(), strands.outward[:, None, :]))
    taper = np.interp(np.linspace(0.0, 1.0, length), [0.0, 0.6, 1.0], [1.0, 0.9, 0.35])
    half = 0.5 * strands.width[:, None, None] * taper[None, :, None] * across
    vertices = np.stack([strands.points - half, strands.points + half], axis=2).reshape(-1, 3)
    k = 2 * (np.arange(count)[:, None] * length + np.arange(length - 1)[None, :]).reshape(-1, 1)
    triangles = k + np.array([[0, 1, 3, 0, 3, 2]])
    return vertices, triangles.reshape(-1, 3)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Normalise the last axis; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
