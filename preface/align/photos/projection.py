"""How a face appears in several photographs of one lens, with derivatives; fit for any focal length.

Image coordinates are in units of the image's longer side, about its centre. With the inverse focal length
eta = exp(-log_focal), a camera's pose as a rotation R and (u, v, log_scale), and q = exp(log_scale) R X,

    m = (q_xy + (u, v)) / (1 + eta q_z),    image = m (1 + k eta² |m|²).

It is the pinhole camera: the face's origin appears at (u, v), at the depth f exp(-log_scale). Unlike focal
length and depth themselves, these parameters keep their meaning as the focal length grows without bound:
eta = 0 is the orthographic camera.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

LENS = 2  # parameters: log_focal, distortion
POSE = 6  # parameters: rotation (about the camera's axes, applied last), u, v, log_scale
# Depth of any point over that of the face's origin, below which a camera is inside the face.
MIN_DEPTH = 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """Cameras and a face.

    Attributes:
        log_focal: logarithm of the focal length in longer sides.
        distortion: radial coefficient k of normalised coordinates.
        rotation: [V, 3, 3] camera from face.
        placement: [V, 3] u, v, log_scale (longer sides per metre).
        shape: [K] coefficients of the face.
    """

    log_focal: float
    distortion: float
    rotation: np.ndarray
    placement: np.ndarray
    shape: np.ndarray

    def moved(self, step: np.ndarray) -> "Scene":
        """The scene after a step [2 + 6 V + K] in the order of `Linearised.by_lens`, poses, shape."""
        views = len(self.rotation)
        poses = step[LENS : LENS + POSE * views].reshape(views, POSE)
        return Scene(
            self.log_focal + step[0],
            self.distortion + step[1],
            Rotation.from_rotvec(poses[:, :3]).as_matrix() @ self.rotation,
            self.placement + poses[:, 3:],
            self.shape + step[LENS + POSE * views :],
        )

    def views(self, keep: np.ndarray) -> "Scene":
        """The scene with some of its views."""
        return replace(self, rotation=self.rotation[keep], placement=self.placement[keep])

    def translations(self) -> np.ndarray:
        """Translations [V, 3] of camera from face, metres."""
        u, v, log_scale = self.placement.T
        depth = np.exp(self.log_focal - log_scale)
        return np.stack([u * np.exp(-log_scale), v * np.exp(-log_scale), depth], axis=-1)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Where points appear, in longer sides, and how that changes.

    Attributes:
        image: [V, N, 2]; NaN at and behind `MIN_DEPTH`.
        by_lens: [V, N, 2, 2] by log_focal and distortion.
        by_pose: [V, N, 2, 6].
        by_point: [V, N, 2, 3] by the point in the face's frame.
    """

    image: np.ndarray
    by_lens: np.ndarray
    by_pose: np.ndarray
    by_point: np.ndarray


def project(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Where points [N, 3] of the face appear, [V, N, 2] longer sides; NaN at and behind `MIN_DEPTH`."""
    eta = np.exp(-scene.log_focal)
    ideal, depth, _ = _ideal(scene, points)
    factor = 1 + scene.distortion * eta**2 * (ideal**2).sum(-1, keepdims=True)
    return np.where(depth[..., None] > MIN_DEPTH, factor * ideal, np.nan)


def linearise(scene: Scene, points: np.ndarray) -> Linearised:
    """`project` with its derivatives."""
    eta, k = np.exp(-scene.log_focal), scene.distortion
    ideal, depth, turned = _ideal(scene, points)
    r2 = (ideal**2).sum(-1)
    factor = (1 + k * eta**2 * r2)[..., None]
    outer = ideal[..., :, None] * ideal[..., None, :]
    distort = factor[..., None] * np.eye(2) + 2 * k * eta**2 * outer  # d image / d ideal

    by_turned = np.zeros((*ideal.shape, 3))  # d ideal / d q
    divisor = _positive(depth)
    by_turned[..., 0, 0] = by_turned[..., 1, 1] = 1 / divisor
    by_turned[..., 2] = -eta * ideal / divisor[..., None]
    by_turned = distort @ by_turned
    by_focal = distort @ (ideal * (eta * turned[..., 2] / divisor)[..., None])[..., None]
    by_focal = by_focal[..., 0] - 2 * k * eta**2 * r2[..., None] * ideal
    by_distortion = ideal * (eta**2 * r2)[..., None]
    by_pose = np.concatenate(
        [
            -by_turned @ _cross(turned),
            distort / divisor[..., None, None],
            by_turned @ turned[..., None],
        ],
        axis=-1,
    )
    scale = np.exp(scene.placement[:, 2])
    by_point = by_turned @ (scale[:, None, None] * scene.rotation)[:, None]
    image = np.where(depth[..., None] > MIN_DEPTH, factor * ideal, np.nan)
    return Linearised(image, np.stack([by_focal, by_distortion], axis=-1), by_pose, by_point)


def _ideal(scene: Scene, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Undistorted image [V, N, 2], relative depth [V, N] and q [V, N, 3]."""
    scale = np.exp(scene.placement[:, 2])[:, None, None]
    turned = scale * np.einsum("vij,nj->vni", scene.rotation, points)
    depth = 1 + np.exp(-scene.log_focal) * turned[..., 2]
    return (turned[..., :2] + scene.placement[:, None, :2]) / _positive(depth)[..., None], depth, turned


def _positive(depth: np.ndarray) -> np.ndarray:
    """Depths that can be divided by; the callers mask the others."""
    return np.where(depth > MIN_DEPTH, depth, 1.0)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Matrices [..., 3, 3] of the cross product with vectors [..., 3] from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
