"""Covariances of what the user sees (cameras, points, distances) from the covariance of the scene's unknowns."""

from dataclasses import dataclass

import numpy as np

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.photos.face import FacePrior, keypoint_weights
from preface.align.photos.projection import LENS, POSE, Scene


@dataclass(frozen=True, eq=False)
class Lengths:
    """Vectors in metres [M, 3] and their derivatives by the scene's unknowns [M, 3, size]."""

    value: np.ndarray
    by_scene: np.ndarray


@dataclass(frozen=True, eq=False)
class Scale:
    """The factor from the scene's unit to metres.

    Attributes:
        factor: of every length.
        by_scene: [size] derivative of its logarithm by the scene's unknowns; zero where the face's size is taken
            as it came out.
        deviation: relative, of the distance that set it.
    """

    factor: float
    by_scene: np.ndarray
    deviation: float

    def apply(self, lengths: Lengths, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scaled vectors [M, 3] and the covariance [M, 3, 3] of each."""
        value = self.factor * lengths.value
        by_scene = self.factor * lengths.by_scene + value[..., None] * self.by_scene
        spread = by_scene @ covariance @ np.swapaxes(by_scene, -1, -2)
        return value, spread + self.deviation**2 * value[..., :, None] * value[..., None, :]


def face_points(scene: Scene, face: FacePrior, weights: np.ndarray | None = None) -> Lengths:
    """Landmarks, or the weighted means [M, N] of them."""
    views = len(scene.rotation)
    points, basis = face.points(scene.shape), face.basis
    if weights is not None:
        points, basis = weights @ points, np.einsum("mn,nck->mck", weights, basis)
    by_scene = np.zeros((*points.shape, LENS + POSE * views + len(scene.shape)))
    by_scene[..., LENS + POSE * views :] = basis
    return Lengths(points, by_scene)


def translations(scene: Scene) -> Lengths:
    """Translations of camera from face."""
    value = scene.translations()
    by_scene = np.zeros((*value.shape, LENS + POSE * len(value) + len(scene.shape)))
    for view, (x, y, z) in enumerate(value):
        u, v, scale = LENS + POSE * view + np.array([3, 4, 5])
        shrink = np.exp(-scene.placement[view, 2])
        by_scene[view, 0, u] = by_scene[view, 1, v] = shrink
        by_scene[view, :, scale] = [-x, -y, -z]
        by_scene[view, 2, 0] = z
    return Lengths(value, by_scene)


def centres(scene: Scene) -> Lengths:
    """Camera centres -R^T t; R turns by exp(w) R."""
    moved = translations(scene)
    value = -np.einsum("vji,vj->vi", scene.rotation, moved.value)
    by_scene = -np.swapaxes(scene.rotation, -1, -2) @ moved.by_scene
    for view, (x, y, z) in enumerate(moved.value):
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        first = LENS + POSE * view
        by_scene[view, :, first : first + 3] -= scene.rotation[view].T @ cross
    return Lengths(value, by_scene)


def distance(lengths: Lengths, first: int, second: int) -> tuple[float, np.ndarray]:
    """The distance between two of the vectors, and its derivative [size] by the scene's unknowns."""
    apart = lengths.value[first] - lengths.value[second]
    length = float(np.linalg.norm(apart))
    return length, (apart / length) @ (lengths.by_scene[first] - lengths.by_scene[second])


def scale_of(
    scene: Scene,
    face: FacePrior,
    ids: list[str],
    known: tuple[str, str, float] | None,
    deviation: float,
) -> Scale:
    """The scale by a known distance (metres, with its deviation), or by the face's own size."""
    if known is None:
        return Scale(1.0, np.zeros(LENS + POSE * len(ids) + len(scene.shape)), 0.0)
    first, second, metres = known
    if first in CANONICAL_KEYPOINTS:
        lengths, names = face_points(scene, face, keypoint_weights()), list(CANONICAL_KEYPOINTS)
    else:
        lengths, names = centres(scene), ids
    found, gradient = distance(lengths, names.index(first), names.index(second))
    return Scale(metres / found, -gradient / found, deviation / metres)


def camera_covariance(
    scene: Scene, view: int, longer_side: int, scale: Scale, covariance: np.ndarray
) -> np.ndarray:
    """Covariance [8, 8] of focal length (px), distortion, rotation (radians) and translation (metres)."""
    size = LENS + POSE * len(scene.rotation) + len(scene.shape)
    rows = np.zeros((8, size))
    rows[0, 0] = longer_side * np.exp(scene.log_focal)
    rows[1, 1] = 1.0
    first = LENS + POSE * view
    rows[2:5, first : first + 3] = np.eye(3)
    moved = translations(scene)
    value = scale.factor * moved.value[view]
    rows[5:8] = scale.factor * moved.by_scene[view] + value[:, None] * scale.by_scene
    spread = rows @ covariance @ rows.T
    spread[5:8, 5:8] += scale.deviation**2 * np.outer(value, value)
    return spread
