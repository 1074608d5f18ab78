"""Where FaceMesh puts landmarks wrong, by the direction from which it sees the face, and how far it errs besides.

FaceMesh draws the face that it expects: seen from the side it makes noses longer, from above and below it slides along
the chin, and all views of one person do so alike, so that no agreement between views shows it. What it does on average
is known from heads whose surface is known (`tools/landmark_bias.py`), as an offset of each landmark across the line of
sight, a quadratic polynomial in the direction of the camera, exactly as wrong on the left half as on the right. What is
left differs from person to person; its size by direction says what a landmark of a view is worth. A cubic fits the
synthetic heads no better, and made the views of a real face agree less.

The face's frame is the canonical one, in units of the distance between its outer eye corners. With d = (x, y, z) the
direction from the face to the camera, offsets are along e1 = up x d and e2 = d x e1, the camera's right and up when it
stands upright:

    offset = sum over i + j <= 2 of C_ij x^i y^j,    variance = v0 + vx x² + vu max(y, 0)² + vd min(y, 0)².
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from preface.align.keypoints import FACEMESH478, SCHEMES
from preface.geometry import GeometryError, Similarity, Views, fit_similarity, lens

FILE = "landmark_bias.npz"
POWERS = tuple((i, j) for i in range(3) for j in range(3 - i))
LEAST_KEYPOINTS = 3  # that determine where a face looks
# Error of a landmark that the studio's heads had by chance smaller: a part of the eye distance.
LEAST_DEVIATION = 0.005


@dataclass(frozen=True, eq=False)
class LandmarkBias:
    """What a detector does on average. N landmarks, in the order of its scheme.

    Attributes:
        name: as files record it.
        scheme: the landmark scheme.
        points: float64 [N, 3], an average face in its own frame, which says where a face looks; eye distances.
        coefficients: float64 [N, 2, len(POWERS)], along e1 and e2, in eye distances.
        variances: float64 [N, 4], of each coordinate, squared eye distances, not negative.
        reach: [2] half axes of the ellipse of directions (x, y) that were seen; beyond it the offset is that of
            its border, as a polynomial knows nothing there, and the variance grows on.
    """

    name: str
    scheme: str
    points: np.ndarray
    coefficients: np.ndarray
    variances: np.ndarray
    reach: np.ndarray

    @property
    def keypoints(self) -> np.ndarray:
        """The five keypoints [5, 3] of the average face."""
        return np.stack([self.points[list(some)].mean(0) for some in SCHEMES[self.scheme].keypoints.values()])

    def across(self, directions: np.ndarray) -> np.ndarray:
        """Offsets [..., N, 2] along e1 and e2 for unit vectors [..., 3] towards the camera; eye distances."""
        inside = directions[..., :2] / np.maximum(
            np.linalg.norm(directions[..., :2] / self.reach, axis=-1, keepdims=True), 1.0
        )
        return np.einsum("...m,ncm->...nc", monomials(inside), self.coefficients)

    def deviations(self, directions: np.ndarray) -> np.ndarray:
        """Standard deviation [..., N] of each coordinate that is left; eye distances."""
        variance = np.einsum("...m,nm->...n", squares(directions), self.variances)
        return np.sqrt(np.maximum(variance, LEAST_DEVIATION**2))


def monomials(directions: np.ndarray) -> np.ndarray:
    """[..., len(POWERS)] of directions [..., 2 or 3]."""
    x, y = directions[..., 0], directions[..., 1]
    return np.stack([x**i * y**j for i, j in POWERS], axis=-1)


def squares(directions: np.ndarray) -> np.ndarray:
    """[..., 4] that the variance is linear in, of directions [..., 2 or 3]."""
    x, y = directions[..., 0], directions[..., 1]
    return np.stack([np.ones_like(x), x**2, np.maximum(y, 0) ** 2, np.minimum(y, 0) ** 2], axis=-1)


def axes_across(directions: np.ndarray) -> np.ndarray:
    """e1 and e2 [..., 2, 3] of unit vectors [..., 3]; no direction is straight up or down."""
    right = np.cross([0.0, 1.0, 0.0], directions)
    right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), np.finfo(float).tiny)
    return np.stack([right, np.cross(directions, right)], axis=-2)


@dataclass(frozen=True, eq=False)
class Expected:
    """What a bias does to the landmarks of one face in V views, in the frame and unit of the cameras' world.

    Attributes:
        points: float64 [N, 3], an average face where this one is.
        offsets: float64 [V, N, 3], by how much each view marks the landmarks beside the points of the skin.
        deviations: float64 [V, N], standard deviation of each coordinate of what differs from person to person.
        eye_distance: of the average face.
    """

    points: np.ndarray
    offsets: np.ndarray
    deviations: np.ndarray
    eye_distance: float


def expect(bias: LandmarkBias, keypoints: np.ndarray, centres: np.ndarray) -> Expected | None:
    """Say what a bias does to a face that is roughly known.

    Args:
        bias: of the detector.
        keypoints: [5, 3] of the face, NaN where missing.
        centres: [V, 3] of the cameras, in the same frame and unit.

    Returns:
        None where the keypoints do not tell where the face looks.
    """
    known = np.isfinite(keypoints).all(-1)
    if known.sum() < LEAST_KEYPOINTS:
        return None
    try:
        fit = fit_similarity(
            bias.keypoints, np.where(known[:, None], keypoints, 0.0), known.astype(float)
        ).target_from_source
    except GeometryError:  # keypoints in one place or on a line
        return None
    return expected_at(bias, fit, bias.points, centres)


def expected_at(
    bias: LandmarkBias, world_from_face: Similarity, points: np.ndarray, centres: np.ndarray
) -> Expected:
    """The same for points [N, 3] of the face's frame, in eye distances, whose place is known."""
    rotation, size = np.asarray(world_from_face.rotation), float(world_from_face.scale)
    directions = (centres - np.asarray(world_from_face.translation)) @ rotation
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    inward = np.einsum("vnc,vca->vna", bias.across(directions), axes_across(directions))
    return Expected(
        points=world_from_face.apply(points),
        offsets=size * inward @ rotation.T,
        deviations=size * bias.deviations(directions),
        eye_distance=size,
    )


def pixel_shifts(expected: Expected, cameras: Views) -> np.ndarray:
    """Pixels [V, N, 2] to be added to the landmarks of V views; 0 where a view cannot see the point."""
    points = np.broadcast_to(expected.points, expected.offsets.shape)
    poses = cameras.world_from_camera
    shifts = np.zeros((*points.shape[:-1], 2))
    for sign, place in ((1, points), (-1, points + expected.offsets)):
        in_camera = np.einsum("vba,vnb->vna", poses[:, :, :3], place - poses[:, None, :, 3])
        shifts += (
            sign * lens.project(cameras.intrinsics[:, None], cameras.monotonic_radius[:, None], in_camera)[0]
        )
    return np.where(np.isfinite(shifts), shifts, 0.0)


@cache
def shipped_bias() -> LandmarkBias:
    """That of the FaceMesh model which mediapipe 0.10.21 ships, as `tools/landmark_bias.py` measured it."""
    with (files("preface.align") / FILE).open("rb") as file, np.load(file) as data:
        arrays = {name: data[name] for name in ("points", "coefficients", "variances", "reach")}
        name = str(data["name"])
    floats = {key: values.astype(np.float64) for key, values in arrays.items()}
    return LandmarkBias(name=name, scheme=FACEMESH478.name, **floats)
